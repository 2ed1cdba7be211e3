//! Initial terms as forcing of the state channels: derivatives of powers of t by Caputo's definition.

use crate::equation::ORDER_GRAIN;
use crate::error::{Error, Result};
pub(super) use crate::friction::initial_state::Link;
use crate::friction::initial_state::{solve_feedthrough, Sum};

/// Powers of t, (exponent, coefficient), of the derivative of an output of this order, from those of all equations.
///
/// D^ρ I^η y is I^η D^ρ y, and the powers of t that y(0), y′(0), … add. They cancel those of Caputo's initial terms.
pub(super) fn channel_powers(
    equation: usize,
    order: f64,
    links: &[Vec<Link>],
    powers: &[Vec<(f64, f64)>],
) -> Result<Vec<(f64, f64)>> {
    let mut sum = Sum::default();
    powers[equation].iter().for_each(|&(exponent, value)| sum.add(exponent, value));
    let mut whole = 0.0;
    while whole < order - ORDER_GRAIN {
        let at = |own: &Vec<(f64, f64)>| -> f64 {
            own.iter().filter(|p| (p.0 - whole).abs() < ORDER_GRAIN).map(|p| p.1).sum()
        };
        let given: Vec<f64> = powers.iter().map(at).collect();
        let begun = solve_feedthrough(&given, links)?;
        for link in links[equation].iter().filter(|link| link.integration.abs() >= ORDER_GRAIN) {
            let exponent = link.integration + whole;
            let value = begun[link.output] * libm::tgamma(whole + 1.0);
            sum.add(exponent, link.coefficient * value / libm::tgamma(exponent + 1.0));
        }
        whole += 1.0;
    }
    let mut out = Vec::new();
    for (exponent, value) in sum.powers() {
        if order < ORDER_GRAIN {
            out.push((exponent, value));
            continue;
        }
        let is_whole = (exponent - exponent.round()).abs() < ORDER_GRAIN;
        if value == 0.0 || (is_whole && exponent < order - ORDER_GRAIN) {
            continue;
        }
        if exponent - order <= -1.0 {
            return Err(Error::OutOfRange {
                name: "exponent of an initial term".into(),
                value: exponent,
                range: format!("above {}, or 0, 1, …", order - 1.0),
                remedy: "the derivative in a non-linear term has no mean over the first pulse".into(),
            });
        }
        let scale = libm::tgamma(exponent + 1.0) / libm::tgamma(exponent - order + 1.0);
        out.push((exponent - order, value * scale));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn initial_values_leave_no_power_that_caputo_derivatives_lack() -> Result<()> {
        // D² y = −c D^0.6 y from y = 3 + 2 t: y is 3 + 2 t plus −c I^1.4 (y − 3), whose 3 t^1.4 cancels.
        let links = vec![vec![Link { output: 0, order: 0.6, integration: 1.4, coefficient: -0.7 }]];
        let taken = 0.7 * 3.0 / libm::tgamma(2.4);
        let powers = vec![vec![(0.0, 3.0), (1.0, 2.0), (1.4, taken)]];
        assert_eq!(channel_powers(0, 1.0, &links, &powers)?, [(0.0, 2.0)]);
        let half = channel_powers(0, 0.5, &links, &powers)?;
        assert!(half.len() == 1 && (half[0].0 - 0.5).abs() < 1e-12);
        assert!((half[0].1 - 2.0 / libm::tgamma(1.5)).abs() < 1e-12);
        assert_eq!(channel_powers(0, 0.0, &links, &powers)?.len(), 3);
        Ok(())
    }
}
