//! The bindings' one rule, read from their source: every entry computes through one of the two wrappers of errors.rs.

use std::path::PathBuf;

/// Name and body of every function that Python can call in a file of bindings.
fn entries(text: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let (mut methods, mut function) = (false, false);
    let mut lines = text.lines().peekable();
    while let Some(line) = lines.next() {
        match line {
            "#[pymethods]" => methods = true,
            "#[pyfunction]" => function = true,
            "}" if methods => methods = false,
            _ => {}
        }
        let code = line.trim_start();
        let indent = line.len() - code.len();
        let starts = (methods && indent == 4) || (function && indent == 0);
        if starts && (code.starts_with("fn ") || code.starts_with("pub fn ")) {
            let name = code.split("fn ").nth(1).unwrap().split(['(', '<']).next().unwrap().to_owned();
            let end = format!("{}}}", " ".repeat(indent));
            let mut body = String::from(line);
            for next in lines.by_ref() {
                body.push('\n');
                body.push_str(next);
                if next == end {
                    break;
                }
            }
            found.push((name, body));
            function = false;
        }
    }
    found
}

#[test]
fn every_python_function_uses_a_wrapper() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("rust/python");
    let mut count = 0;
    let searches = ["order_search/grid_search.rs", "order_search/stage.rs"];
    for file in ["estimation.rs", "operators.rs", "simulation.rs", "virtual_arm.rs"].into_iter().chain(searches) {
        let text = std::fs::read_to_string(folder.join(file)).unwrap();
        // One entry sets a flag, for tests, and computes nothing.
        for (name, body) in entries(&text).into_iter().filter(|(name, _)| name != "force_portable") {
            let ways = [
                "run_detached(py",
                "run_attached(",
                "map_rows(py",
                "run_watched(py",
                "run_checkpointed(py",
                "run_interruptible(py",
            ];
            assert!(ways.iter().any(|way| body.contains(way)), "{file}: {name} computes outside the wrappers");
            count += 1;
        }
    }
    assert!(count >= 45, "only {count} entries were found");
}

#[test]
fn only_wrappers_release_the_gil_and_catch_panics() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("rust/python");
    for file in ["convert.rs", "estimation.rs", "mod.rs", "operators.rs", "simulation.rs", "virtual_arm.rs"] {
        let text = std::fs::read_to_string(folder.join(file)).unwrap();
        assert!(!text.contains(".detach(") && !text.contains("catch_unwind"), "{file}");
    }
}
