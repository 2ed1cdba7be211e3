//! Free limits of inputs: their slopes against differences, and that they are found, with friction and without.

use ftlm::equation::{AffineOrder, Initial};
use ftlm::error::Error;
use ftlm::estimation::output_error::{
    self, Coordinate, Experiment, FreeEquation, FreeInput, FreeModel, InputLaw, MinimizationSettings, Monomial,
    ParameterPoint, PointValues,
};
use ftlm::friction::FrictionLaw;
use ftlm::nonlinear::{self, FreeFrictionLaw, InitialGuess, NonlinearModel, NonlinearSystem};
use ftlm::parallel::Stop;
use ftlm::regressors::Record;
use ftlm::signal::block_pulse::{point_samples, PulseMeans};

use crate::common::{norm, relative_distance, Random};

const STEP: f64 = 0.02;
const M: usize = 400;

/// What is commanded: levels that hold for a while.
fn command(seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    let levels: Vec<f64> = (0..M / 20).map(|_| 2.0 * random.normal()).collect();
    (0..M).map(|k| levels[k / 20]).collect()
}

/// What acts, by hand.
fn apply_law_naively(command: &[f64], law: InputLaw, limit: f64) -> Vec<f64> {
    let bent = |v: f64| match law {
        InputLaw::Saturation if v > limit => limit,
        InputLaw::Saturation if v < -limit => -limit,
        InputLaw::DeadZone if v > limit => v - limit,
        InputLaw::DeadZone if v < -limit => v + limit,
        InputLaw::DeadZone => 0.0,
        _ => v,
    };
    command.iter().map(|&v| bent(v)).collect()
}

fn free(i: usize, factor: f64) -> Monomial {
    Monomial { factor, powers: vec![(i, 1)] }
}

fn order(constant: f64, weight: f64) -> AffineOrder {
    AffineOrder { constant, weights: vec![weight] }
}

/// D^α y = −v Dy + g u, α, v and g free.
fn equation() -> FreeEquation {
    FreeEquation {
        output: 0,
        order: order(0.0, 1.0),
        terms: vec![(0, order(1.0, 0.0), free(0, -1.0)), (1, order(0.0, 0.0), free(1, 1.0))],
    }
}

fn limited_inputs(law: InputLaw) -> Vec<FreeInput> {
    vec![FreeInput { signal: 1, law, bounds: (0.0, 3.0) }]
}

fn linear(law: InputLaw) -> FreeModel {
    FreeModel {
        equations: vec![equation()],
        order_bounds: vec![(1.2, 2.0)],
        coordinates: vec![Coordinate::Plain; 2],
        inputs: limited_inputs(law),
        coupled: false,
        priors: Vec::new(),
        initial: Initial::Rest,
    }
}

fn friction_model(law: InputLaw) -> NonlinearModel {
    let model = FreeModel { coordinates: vec![Coordinate::Plain; 3], coupled: true, ..linear(law) };
    let frictions = vec![(0, FreeFrictionLaw::coulomb(free(2, 1.0)))];
    NonlinearModel { model, derived: vec![], frictions, filtered: vec![] }
}

/// A run of a body with friction f (or none) whose input acts as a law says; the record has it as commanded.
fn run(law: InputLaw, limit: f64, f: f64, seed: u64) -> Result<Experiment, Error> {
    use ftlm::equation::{Equation, Structure, Term};
    let u = command(seed);
    let terms = vec![Term { signal: 0, order: 1.0 }, Term { signal: 1, order: 0.0 }];
    let structure = Structure { output: 0, order: 1.8, terms };
    let equation = Equation { structure, coefficients: vec![-1.0, 1.5] };
    let body = NonlinearSystem::with_friction(vec![equation], vec![(0, FrictionLaw::coulomb(f))], 2);
    let record =
        Record::new(STEP, PulseMeans::from_signals(vec![vec![0.0; M], apply_law_naively(&u, law, limit)]), None)?;
    let output = body.run(&record, &[vec![]])?.outputs.swap_remove(0);
    let record = Record::new(STEP, PulseMeans::from_signals(vec![output.clone(), u]), None)?;
    Experiment::new(record, 1, vec![point_samples(&output)], vec![1.0])
}

const LAWS: [(InputLaw, f64); 2] = [(InputLaw::Saturation, 1.3), (InputLaw::DeadZone, 0.4)];

#[test]
fn derivative_by_input_limit_matches_the_residuals() -> Result<(), Error> {
    let settings = MinimizationSettings { evaluations: 1, ..MinimizationSettings::default() };
    for (law, limit) in LAWS {
        let mut experiment = run(law, limit, 0.0, 3)?;
        // Held inputs act at once at their samples; friction is followed on pulse means alone.
        for held in [false, true] {
            experiment.point_values =
                vec![PointValues::default(), PointValues { values: None, is_zero_order_hold: held }].into();
            let here = |value: f64| {
                let start = ParameterPoint { orders: vec![1.7], coefficients: vec![0.8, 1.4], inputs: vec![value] };
                output_error::fit(&linear(law), std::slice::from_ref(&experiment), &start, settings)
            };
            let (at, up, down) = (here(1.0)?, here(1.0001)?, here(0.9999)?);
            let slope: Vec<f64> = up.residuals.iter().zip(&down.residuals).map(|(u, d)| (u - d) / 2e-4).collect();
            assert!(norm(&slope) > 0.0);
            assert!(relative_distance(&at.jacobian[3], &slope) < 1e-9, "{law:?} {held}");
        }
        experiment.point_values = std::sync::Arc::default();
        let here = |value: f64| {
            let start = InitialGuess {
                orders: vec![1.7],
                coefficients: vec![0.8, 1.4, 0.3],
                inputs: vec![value],
                states: vec![],
            };
            nonlinear::fit(&friction_model(law), std::slice::from_ref(&experiment), &start, settings, &Stop::default())
        };
        let (at, up, down) = (here(1.0)?, here(1.000_001)?, here(0.999_999)?);
        let slope: Vec<f64> = up.residuals.iter().zip(&down.residuals).map(|(u, d)| (u - d) / 2e-6).collect();
        assert!(relative_distance(&at.jacobian[4], &slope) < 1e-4, "{law:?} beside friction");
    }
    Ok(())
}

#[test]
fn input_limit_is_estimated_with_the_other_parameters() -> Result<(), Error> {
    for (law, limit) in LAWS {
        let start = ParameterPoint { orders: vec![1.9], coefficients: vec![0.7, 1.2], inputs: vec![0.9] };
        let found =
            output_error::fit(&linear(law), &[run(law, limit, 0.0, 5)?], &start, MinimizationSettings::default())?;
        assert!((found.point.inputs[0] - limit).abs() < 1e-6, "{law:?} {:?}", found.point);
        assert!((found.point.orders[0] - 1.8).abs() < 1e-6, "{law:?} {:?}", found.point);
        let start =
            InitialGuess { orders: vec![1.9], coefficients: vec![0.7, 1.2, 0.3], inputs: vec![0.9], states: vec![] };
        let settings = MinimizationSettings { evaluations: 300, tolerance: 1e-14 };
        let found =
            nonlinear::fit(&friction_model(law), &[run(law, limit, 0.5, 7)?], &start, settings, &Stop::default())?;
        assert!((found.inputs[0] - limit).abs() < 1e-4, "{law:?} {:?} {:?}", found.inputs, found.coefficients);
        assert!((found.coefficients[2] - 0.5).abs() < 1e-4, "{law:?} {:?}", found.coefficients);
    }
    Ok(())
}

#[test]
fn invalid_input_limits_are_rejected() -> Result<(), Error> {
    let experiment = run(InputLaw::Saturation, 1.0, 0.0, 3)?;
    let one = |signal: usize, bounds: (f64, f64)| FreeInput { signal, law: InputLaw::Saturation, bounds };
    for inputs in
        [vec![one(0, (0.0, 1.0))], vec![one(9, (0.0, 1.0))], vec![one(1, (1.0, 0.5))], vec![one(1, (0.0, 1.0)); 2]]
    {
        let model = FreeModel { inputs: inputs.clone(), ..linear(InputLaw::Saturation) };
        assert!(matches!(model.check(std::slice::from_ref(&experiment)), Err(Error::Structure { .. })));
        let mut model = friction_model(InputLaw::Saturation);
        model.model.inputs = inputs;
        assert!(matches!(model.check(std::slice::from_ref(&experiment)), Err(Error::Structure { .. })));
    }
    let late = |bounds: (f64, f64)| {
        let mut model = friction_model(InputLaw::Saturation);
        model.model.inputs = vec![FreeInput { signal: 1, law: InputLaw::Delay, bounds }];
        model
    };
    late((0.0, 0.2)).check(std::slice::from_ref(&experiment))?;
    assert!(matches!(late((0.0, f64::INFINITY)).check(&[experiment]), Err(Error::Structure { .. })));
    Ok(())
}
