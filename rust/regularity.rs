//! Whether coupled equations tell their outputs apart: the leading matrix of the system.

use crate::equation::{Equation, ORDER_GRAIN};
use crate::error::{Error, Result};

/// All choices of columns are looked at, 2^n of them; a larger system goes unlooked.
const MOST_EQUATIONS: usize = 16;

/// Highest order of an entry of the system, its coefficient, and the sum of sizes that this coefficient is made of.
type Leading = Option<(f64, f64, f64)>;

fn added(sum: Leading, order: f64, value: f64, size: f64) -> Leading {
    match sum {
        Some((highest, v, s)) if (order - highest).abs() < ORDER_GRAIN => Some((highest, v + value, s + size)),
        Some((highest, ..)) if order < highest => sum,
        _ => Some((order, value, size)),
    }
}

/// Refuses equations that together leave some output undetermined: as operators in s their determinant must be of the
/// order that its largest products say. Where those cancel, the equations repeat or contradict each other.
///
/// # Errors
/// [`Error::Structure`].
///
/// ```
/// use ftlm::equation::{Equation, Structure, Term};
/// // D x = c D^1.5 y, D^1.5 y = D x + u: the same twice where c is 1.
/// let pair = |c: f64| {
///     let of = |output, order, terms, c| Equation::new(Structure { output, order, terms }, c);
///     let first = of(0, 1.0, vec![Term { signal: 1, order: 1.5 }], vec![c])?;
///     let input = Term { signal: 2, order: 0.0 };
///     ftlm::regularity::check_regular(&[first, of(1, 1.5, vec![Term { signal: 0, order: 1.0 }, input], vec![1.0, 1.0])?])
/// };
/// assert!(pair(0.5).is_ok() && pair(1.0).is_err());
/// ```
pub fn check_regular(equations: &[Equation]) -> Result<()> {
    let n = equations.len();
    if !(2..=MOST_EQUATIONS).contains(&n) {
        return Ok(());
    }
    let entry = |i: usize, j: usize| -> Leading {
        let Equation { structure, coefficients } = &equations[i];
        let output = equations[j].structure.output;
        let mut sum = (i == j).then_some((structure.order, 1.0, 1.0));
        for (term, &c) in structure.terms.iter().zip(coefficients) {
            if term.signal == output && c != 0.0 {
                sum = added(sum, term.order, -c, c.abs());
            }
        }
        sum
    };
    let entries: Vec<Vec<Leading>> = (0..n).map(|i| (0..n).map(|j| entry(i, j)).collect()).collect();
    // Rows are taken in order; which columns they took is all that the rest needs to know.
    let mut taken: Vec<Leading> = vec![None; 1 << n];
    taken[0] = Some((0.0, 1.0, 1.0));
    for columns in 0..(1usize << n) {
        let Some((order, value, size)) = taken[columns] else { continue };
        let row = columns.count_ones() as usize;
        for j in (0..n).filter(|j| columns & (1 << j) == 0) {
            let Some((o, v, s)) = entries[row][j] else { continue };
            let later = (columns >> j).count_ones();
            let sign = if later % 2 == 0 { 1.0 } else { -1.0 };
            let next = columns | (1 << j);
            taken[next] = added(taken[next], order + o, sign * value * v, size * s);
        }
    }
    match taken[(1 << n) - 1] {
        Some((_, value, size)) if value.abs() > 1e-12 * size => Ok(()),
        _ => Err(Error::Structure {
            what:
                "the leading matrix of the equations is singular: their highest orders cancel each other, so they do \
                   not tell their outputs apart"
                    .into(),
            remedy: "take out an equation that repeats another, or change an order or a coefficient".into(),
        }),
    }
}
