//! Time scaling: every product before a term is the power of the time unit that its orders imply.

use ftlm::equation::{AffineOrder, Initial};
use ftlm::estimation::joint_fit::{Problem, TimeScaling};
use ftlm::estimation::output_error::{Coordinate, FreeEquation, FreeModel, Monomial};

use crate::common::check;

type Orders = (f64, [f64; 2]);
type Terms<'a> = &'a [(usize, Orders, &'a [(usize, i32)])];

fn order((constant, weights): Orders) -> AffineOrder {
    AffineOrder { constant, weights: weights.to_vec() }
}

fn problem(equations: &[(Orders, Terms<'_>)], coefficients: usize) -> Problem {
    let of = |(output, (highest, terms)): (usize, &(Orders, Terms<'_>))| {
        let monomial = |powers: &[(usize, i32)]| Monomial { factor: -2.0, powers: powers.to_vec() };
        let terms = terms.iter().map(|(signal, nu, powers)| (*signal, order(*nu), monomial(powers))).collect();
        FreeEquation { output, order: order(*highest), terms }
    };
    let model = FreeModel {
        equations: equations.iter().enumerate().map(of).collect(),
        order_bounds: vec![(0.05, 3.0); 2],
        coordinates: vec![Coordinate::Plain; coefficients],
        inputs: Vec::new(),
        coupled: true,
        priors: Vec::new(),
        initial: Initial::Rest,
    };
    let outputs = (0..equations.len()).map(|k| format!("y{k}")).collect();
    Problem::new(outputs, model, Vec::new()).unwrap()
}

const ALPHA: Orders = (0.0, [1.0, 0.0]);
const MU: Orders = (0.0, [0.0, 1.0]);
const FREE: [f64; 2] = [1.7, 0.6];
const SPANS: [(f64, f64); 2] = [(0.01, 20.0), (0.02, 7.0)];

/// What every product grows by in the unit, beside what its orders say.
fn compare(name: &str, equations: &[(Orders, Terms<'_>)], values: &[f64]) {
    let problem = problem(equations, values.len());
    let clock = TimeScaling::from_runs(&problem, &SPANS);
    let all = [FREE.as_slice(), values].concat();
    let told = clock.to_scaled(&all);
    assert_eq!(told[..2], FREE, "{name}");
    for (highest, terms) in equations {
        for (_, nu, powers) in *terms {
            let product = |of: &[f64]| powers.iter().map(|&(j, n)| of[2 + j].powi(n)).product::<f64>();
            let time = order(*highest).at(&FREE) - order(*nu).at(&FREE);
            let wanted = if powers.is_empty() { 0.0 } else { time * clock.unit() };
            check(name, ((product(&told) / product(&all)).ln() - wanted).abs(), 1e-12);
        }
    }
    let back = clock.to_unscaled(&told);
    check(name, back.iter().zip(&all).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max), 1e-14);
}

#[test]
fn products_of_a_law_have_consistent_powers_of_time() {
    let none: Orders = (0.0, [0.0, 0.0]);
    compare(
        "each alone",
        &[(ALPHA, &[(0, MU, &[(0, 1)]), (0, none, &[(1, 1)]), (1, none, &[(2, 1)])])],
        &[2.0, 3.0, 5.0],
    );
    // A ratio beside numbers that stand alone elsewhere is a number; one whose partner is squared is a root of time.
    let hub: Terms<'_> = &[(0, MU, &[(0, 1)]), (1, none, &[(1, 1)]), (1, MU, &[(0, 1), (2, 1)])];
    let link: Terms<'_> = &[(1, none, &[(1, 1), (2, 2)]), (0, MU, &[(0, 1)])];
    compare("a law", &[(ALPHA, hub), (ALPHA, link)], &[0.3, 9.0, 1.4]);
    compare("a square", &[(ALPHA, &[(0, MU, &[(0, 2)]), (1, none, &[(0, 1), (1, 1)])])], &[0.3, 9.0]);
    compare("nothing but a product", &[(ALPHA, &[(0, MU, &[(0, 1), (1, 1)])])], &[0.3, 9.0]);
    compare("a number that is known", &[(ALPHA, &[(0, MU, &[]), (1, none, &[(0, 1)])])], &[0.3]);
}

#[test]
fn coefficient_of_several_orders_keeps_its_unit() {
    let none: Orders = (0.0, [0.0, 0.0]);
    let terms: Terms<'_> = &[(0, MU, &[(0, 1)]), (1, none, &[(1, 1)]), (1, MU, &[(1, 1), (0, 1)])];
    let clock = TimeScaling::from_runs(&problem(&[(ALPHA, terms)], 2), &SPANS);
    assert_eq!(clock.to_scaled(&[1.7, 0.6, 2.0, 3.0]), [1.7, 0.6, 2.0, 3.0]);
    // Beside the laws' absence the first term tells: each number is still one.
    let terms: Terms<'_> = &[(0, MU, &[(0, 1)]), (1, none, &[(0, 1)])];
    let clock = TimeScaling::from_runs(&problem(&[(ALPHA, terms)], 1), &SPANS);
    check("the first", (clock.to_scaled(&[1.7, 0.6, 2.0])[2] / 2.0).ln() - 1.1 * clock.unit(), 1e-12);
}
