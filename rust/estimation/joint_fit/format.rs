//! Formatting of numbers with few significant digits.

/// Format a number like `g` in C and Python, with at most `digits` significant digits and no trailing zeros.
pub(crate) fn format_general(value: f64, digits: usize) -> String {
    if !value.is_finite() {
        return if value.is_nan() {
            "nan".into()
        } else if value > 0.0 {
            "inf".into()
        } else {
            "-inf".into()
        };
    }
    let decimals = digits.max(1) - 1;
    // The exponent is that of the rounded value: 9.99 in two digits is 10.
    let rounded = format!("{value:.decimals$e}");
    let Some((mantissa, exponent)) = rounded.split_once('e') else { return rounded };
    let power: i64 = exponent.parse().unwrap_or(0);
    match usize::try_from(power) {
        Ok(whole) if whole <= decimals => trim_zeros(&format!("{value:.*}", decimals - whole)).into(),
        Err(_) if power >= -4 => {
            let places = usize::try_from(-power).unwrap_or(0) + decimals;
            trim_zeros(&format!("{value:.places$}")).into()
        }
        _ => {
            let sign = if power < 0 { '-' } else { '+' };
            format!("{}e{sign}{:02}", trim_zeros(mantissa), power.abs())
        }
    }
}

/// Remove trailing zeros after the decimal point, and a decimal point at the end.
fn trim_zeros(text: &str) -> &str {
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.')
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use super::format_general;

    #[test]
    fn format_matches_python() {
        let three = [
            (1e-5, "1e-05"),
            (0.000_123_456, "0.000123"),
            (0.000_099_96, "0.0001"),
            (0.5, "0.5"),
            (12.34, "12.3"),
            (12.35, "12.3"),
            (-2.5, "-2.5"),
            (0.0, "0"),
            (-0.0, "-0"),
            (99.96, "100"),
            (999.5, "1e+03"),
            (998.5, "998"),
            (1000.0, "1e+03"),
            (123_456.0, "1.23e+05"),
            (1e20, "1e+20"),
            (1e100, "1e+100"),
            (1.5e-300, "1.5e-300"),
            (f64::INFINITY, "inf"),
            (f64::NEG_INFINITY, "-inf"),
            (f64::NAN, "nan"),
        ];
        three.iter().for_each(|(value, text)| assert_eq!(format_general(*value, 3), *text));
        let six = [
            (1e-5, "1e-05"),
            (0.25, "0.25"),
            (1.0, "1"),
            (4.0, "4"),
            (100_000.0, "100000"),
            (123_456.0, "123456"),
            (123_456.5, "123456"),
            (123_457.5, "123458"),
            (999_999.5, "1e+06"),
            (1_000_000.0, "1e+06"),
            (1_234_567.0, "1.23457e+06"),
            (2.0 / 3.0, "0.666667"),
            (-1e-4, "-0.0001"),
        ];
        six.iter().for_each(|(value, text)| assert_eq!(format_general(*value, 6), *text));
    }
}
