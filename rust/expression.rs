//! Expressions of non-linear terms as programs in postfix notation, evaluated together with their derivatives.
//!
//! A channel is a signal or a derivative of a signal. A [`DerivedSignal`] is an expression over channels, such as y³ or
//! |Dy|·Dy. A non-linear term of an equation is a linear term of a derived signal.

use crate::error::{Error, Result};
use crate::fractional::kernels::MAX_ORDER;

/// Elementary function of one argument.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Function {
    /// Sine.
    Sin,
    /// Cosine.
    Cos,
    /// Exponential function.
    Exp,
    /// Hyperbolic tangent.
    Tanh,
    /// Absolute value.
    Abs,
    /// Square root.
    Sqrt,
    /// Sign, 0 at 0.
    Sign,
}

impl Function {
    const ALL: [Self; 7] = [Self::Sin, Self::Cos, Self::Exp, Self::Tanh, Self::Abs, Self::Sqrt, Self::Sign];

    /// Name of the function.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sin => "sin",
            Self::Cos => "cos",
            Self::Exp => "exp",
            Self::Tanh => "tanh",
            Self::Abs => "abs",
            Self::Sqrt => "sqrt",
            Self::Sign => "sign",
        }
    }

    /// Return the value and the derivative of the function at x. The infinite slope of the square root at 0 is replaced
    /// by 0.
    fn apply(self, x: f64) -> (f64, f64) {
        match self {
            Self::Sin => (libm::sin(x), libm::cos(x)),
            Self::Cos => (libm::cos(x), -libm::sin(x)),
            Self::Exp => (libm::exp(x), libm::exp(x)),
            Self::Tanh => {
                let value = libm::tanh(x);
                (value, 1.0 - value * value)
            }
            Self::Abs => (x.abs(), sign(x)),
            Self::Sqrt => (libm::sqrt(x), if x > 0.0 { 0.5 / libm::sqrt(x) } else { 0.0 }),
            Self::Sign => (sign(x), 0.0),
        }
    }
}

fn sign(x: f64) -> f64 {
    if x == 0.0 {
        0.0
    } else {
        x.signum()
    }
}

/// Return the value and the derivative of x^n. The infinite slope at 0 for n < 1 is replaced by 0.
#[allow(clippy::cast_possible_truncation)]
fn power(x: f64, n: f64) -> (f64, f64) {
    if n == 0.0 {
        return (1.0, 0.0);
    }
    if n.fract() == 0.0 && n.abs() < f64::from(i16::MAX) {
        let lower_power = x.powi(n as i32 - 1);
        return (if n > 0.0 { lower_power * x } else { x.powi(n as i32) }, n * lower_power);
    }
    (libm::pow(x, n), if x == 0.0 && n < 1.0 { 0.0 } else { n * libm::pow(x, n - 1.0) })
}

/// Instruction of a program in postfix notation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Instruction {
    /// Push a constant on the stack.
    Constant(f64),
    /// Push the value of the channel with this index on the stack.
    Channel(usize),
    /// Replace the two topmost values of the stack by their sum.
    Add,
    /// Replace the two topmost values of the stack by their product.
    Multiply,
    /// Negate the topmost value of the stack.
    Negate,
    /// Raise the topmost value of the stack to this power.
    Power(f64),
    /// Apply a function to the topmost value of the stack.
    Apply(Function),
}

impl Instruction {
    /// Return the instruction with a name and a number: `constant` (value), `channel` (index), `add`, `multiply`,
    /// `negate`, `power` (exponent), or the name of a function.
    ///
    /// # Errors
    /// [`Error::Structure`] for another name, or a channel index that is not a whole number.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn parse(name: &str, value: f64) -> Result<Self> {
        Ok(match name {
            "constant" => Self::Constant(value),
            "channel" if value >= 0.0 && value.fract() == 0.0 && value < 1e6 => Self::Channel(value as usize),
            "add" => Self::Add,
            "multiply" => Self::Multiply,
            "negate" => Self::Negate,
            "power" => Self::Power(value),
            _ => match Function::ALL.into_iter().find(|function| function.name() == name) {
                Some(function) => Self::Apply(function),
                None => return refuse(format!("instruction '{name}' ({value})"), "use an instruction of expressions"),
            },
        })
    }
}

fn refuse<T>(what: String, remedy: &str) -> Result<T> {
    Err(Error::Structure { what: format!("{what} in a non-linear term"), remedy: remedy.into() })
}

/// Expression over numbered channels, which are signals or derivatives of signals.
///
/// ```
/// use ftlm::expression::{Expression, Function, Instruction, Values};
/// // |x₀| x₀: 4 at −2 with the opposite sign, slope 2 |x₀|.
/// use Instruction::{Apply, Channel, Multiply};
/// let drag = Expression::new(vec![Channel(0), Apply(Function::Abs), Channel(0), Multiply], 1)?;
/// let mut values = Values::default();
/// assert_eq!(drag.evaluate(&[-2.0], &mut values), -4.0);
/// assert_eq!(values.slopes(), [4.0]);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Expression {
    program: Vec<Instruction>,
    channels: usize,
}

impl Expression {
    /// Return the expression that a program computes from `channels` numbered channels.
    ///
    /// # Errors
    /// [`Error::Structure`] for a program that lacks a value or ends with several values, a channel index out of range,
    /// or a number that is not finite.
    pub fn new(program: Vec<Instruction>, channels: usize) -> Result<Self> {
        let mut depth = 0_usize;
        for instruction in &program {
            let argument_count = match instruction {
                Instruction::Constant(_) | Instruction::Channel(_) => 0,
                Instruction::Add | Instruction::Multiply => 2,
                Instruction::Negate | Instruction::Power(_) | Instruction::Apply(_) => 1,
            };
            match instruction {
                Instruction::Constant(value) | Instruction::Power(value) if !value.is_finite() => {
                    return refuse(format!("the number {value}"), "give finite numbers");
                }
                Instruction::Channel(channel) if *channel >= channels => {
                    return refuse(format!("channel {channel} of {channels}"), "number them from 0");
                }
                _ if depth < argument_count => {
                    return refuse(format!("{instruction:?} without a value"), "give its arguments before it")
                }
                _ => depth = depth + 1 - argument_count,
            }
        }
        if depth != 1 {
            return refuse(format!("{depth} values"), "give a program whose result is one value");
        }
        Ok(Self { program, channels })
    }

    /// Number of channels.
    #[must_use]
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Return the value of the expression at the given channel values. Afterwards, [`Values::slopes`] holds its
    /// derivatives and [`Values::rounding_scale`] the size of its rounding error. If a function has no finite value,
    /// [`Values::fault`] names it, and the result is not finite.
    pub fn evaluate(&self, channels: &[f64], values: &mut Values) -> f64 {
        let n = self.channels;
        values.stack.clear();
        values.slopes.clear();
        values.rounding_scales.clear();
        values.fault = None;
        for instruction in &self.program {
            match *instruction {
                Instruction::Constant(value) => {
                    values.stack.push(value);
                    values.rounding_scales.push(value.abs());
                    values.slopes.extend(std::iter::repeat_n(0.0, n));
                }
                Instruction::Channel(channel) => {
                    values.stack.push(channels[channel]);
                    values.rounding_scales.push(channels[channel].abs());
                    let unit = |i| if i == channel { 1.0 } else { 0.0 };
                    values.slopes.extend((0..n).map(unit));
                }
                Instruction::Add => values.combine(n, |a, b| (a + b, 1.0, 1.0)),
                Instruction::Multiply => values.combine(n, |a, b| (a * b, b, a)),
                Instruction::Negate => values.chain(n, "negation", |x| (-x, -1.0)),
                Instruction::Power(exponent) => values.chain(n, "power", |x| power(x, exponent)),
                Instruction::Apply(function) => values.chain(n, function.name(), |x| function.apply(x)),
            }
        }
        values.stack.last().copied().unwrap_or(f64::NAN)
    }
}

/// Intermediate values of an evaluation. Their memory is reused by the next evaluation.
#[derive(Debug, Clone, Default)]
pub struct Values {
    stack: Vec<f64>,
    slopes: Vec<f64>,
    /// Scale of the rounding error of each value on the stack.
    rounding_scales: Vec<f64>,
    fault: Option<(&'static str, f64)>,
}

impl Values {
    /// Derivatives of the last evaluation with respect to each channel.
    #[must_use]
    pub fn slopes(&self) -> &[f64] {
        &self.slopes
    }

    /// Scale of the rounding error of the last evaluation: the error is a small multiple of the machine epsilon times
    /// this value. It exceeds the magnitude of the result where terms cancel, as in (x + 300)⁴ − 300⁴ near x = 0.
    #[must_use]
    pub fn rounding_scale(&self) -> f64 {
        self.rounding_scales.last().copied().unwrap_or(0.0)
    }

    /// Name and argument of the first function without a finite value at a finite argument in the last evaluation; None
    /// if all values were finite.
    #[must_use]
    pub fn fault(&self) -> Option<(&'static str, f64)> {
        self.fault
    }

    fn chain(&mut self, n: usize, name: &'static str, function: impl Fn(f64) -> (f64, f64)) {
        let (Some(top), first) = (self.stack.last_mut(), self.slopes.len() - n) else { return };
        let (value, slope) = function(*top);
        if !value.is_finite() && top.is_finite() && self.fault.is_none() {
            self.fault = Some((name, *top));
        }
        *top = value;
        self.slopes[first..].iter_mut().for_each(|s| *s *= slope);
        if let Some(scale) = self.rounding_scales.last_mut() {
            *scale = slope.abs() * *scale + value.abs();
        }
    }

    fn combine(&mut self, n: usize, function: impl Fn(f64, f64) -> (f64, f64, f64)) {
        let (Some(b), Some(a)) = (self.stack.pop(), self.stack.last_mut()) else { return };
        let (value, slope_a, slope_b) = function(*a, b);
        *a = value;
        if let (Some(scale_b), Some(scale_a)) = (self.rounding_scales.pop(), self.rounding_scales.last_mut()) {
            *scale_a = slope_a.abs() * *scale_a + slope_b.abs() * scale_b + value.abs();
        }
        let split = self.slopes.len() - n;
        let (head, tail) = self.slopes.split_at_mut(split);
        head[split - n..].iter_mut().zip(tail.iter()).for_each(|(a, b)| *a = slope_a * *a + slope_b * b);
        self.slopes.truncate(split);
    }
}

/// Signal that an expression computes from channels, which are signals or derivatives of signals.
#[derive(Debug, Clone, PartialEq)]
pub struct DerivedSignal {
    /// The expression over the channels.
    pub expression: Expression,
    /// (index of the signal, order of its derivative) of each channel.
    pub channels: Vec<(usize, f64)>,
}

impl DerivedSignal {
    /// Return the signal that an expression computes from these channels.
    ///
    /// # Errors
    /// [`Error::Structure`] for a wrong number of channels, or an order that is negative or above 10.
    pub fn new(expression: Expression, channels: Vec<(usize, f64)>) -> Result<Self> {
        if expression.channels() != channels.len() {
            return refuse(
                format!("{} channels for {}", channels.len(), expression.channels()),
                "give one (signal, order) pair per channel",
            );
        }
        if let Some((_, order)) = channels.iter().find(|(_, order)| !(0.0..=MAX_ORDER).contains(order)) {
            return refuse(format!("a derivative of order {order}"), "give an order from 0 to 10");
        }
        Ok(Self { expression, channels })
    }
}

#[cfg(test)]
mod tests {
    use super::Instruction::{Add, Apply, Channel, Constant, Multiply, Negate, Power};
    use super::*;

    #[test]
    fn expression_derivatives_match_differences() -> Result<()> {
        let product = vec![Channel(0), Power(3.0), Channel(1), Multiply, Constant(2.0), Add];
        let nested =
            [Channel(0), Apply(Function::Sin), Channel(1), Apply(Function::Exp), Multiply, Apply(Function::Tanh)];
        let roots = [Channel(0), Apply(Function::Abs), Power(1.5), Negate, Channel(1), Apply(Function::Sqrt), Add];
        let cosine = [Channel(0), Apply(Function::Cos), Channel(0), Apply(Function::Abs), Multiply, Power(-2.0)];
        let mut values = Values::default();
        for program in [product, nested.to_vec(), roots.to_vec(), cosine.to_vec()] {
            let expression = Expression::new(program, 2)?;
            for at in [[0.7, 0.4], [-1.3, 2.0]] {
                let value = expression.evaluate(&at, &mut values);
                let slopes = values.slopes().to_vec();
                assert!(value.is_finite() && slopes.len() == 2 && values.fault().is_none());
                for (i, slope) in slopes.iter().enumerate() {
                    let side = |by: f64| {
                        let mut shifted = at;
                        shifted[i] += by;
                        expression.evaluate(&shifted, &mut Values::default())
                    };
                    let difference = (side(1e-6) - side(-1e-6)) / 2e-6;
                    assert!((slope - difference).abs() < 1e-8 * (1.0 + slope.abs()), "{slope} {difference}");
                }
            }
        }
        Ok(())
    }

    #[test]
    fn rounding_scales_bound_the_errors_of_canceling_terms() -> Result<()> {
        // (x + 293)⁴ − 293⁴ = x (x + 586) ((x + 293)² + 293²), which does not cancel.
        let program = vec![Channel(0), Constant(293.0), Add, Power(4.0), Constant(293.0), Power(4.0), Negate, Add];
        let radiation = Expression::new(program, 1)?;
        let mut values = Values::default();
        for x in [0.0_f64, 1e-15, 3e-9, -2e-4, 1.0, 50.0, -280.0] {
            let exact = x * (x + 586.0) * ((x + 293.0).powi(2) + 293.0_f64.powi(2));
            let error = (radiation.evaluate(&[x], &mut values) - exact).abs();
            let bound = 2.0 * f64::EPSILON * values.rounding_scale();
            assert!(error <= bound && bound < 1e-4, "{x}: {error} {bound}");
        }
        Ok(())
    }

    #[test]
    fn faults_name_the_function_and_its_argument() -> Result<()> {
        let mut values = Values::default();
        let root = Expression::new(vec![Channel(0), Apply(Function::Sqrt)], 1)?;
        assert!(root.evaluate(&[-0.5], &mut values).is_nan());
        assert_eq!(values.fault(), Some(("sqrt", -0.5)));
        let cube = Expression::new(vec![Channel(0), Power(3.0)], 1)?;
        assert!(cube.evaluate(&[1e200], &mut values).is_infinite());
        assert_eq!(values.fault(), Some(("power", 1e200)));
        Ok(())
    }

    #[test]
    fn invalid_expressions_are_rejected() {
        for program in
            [vec![], vec![Add], vec![Channel(0), Channel(0)], vec![Channel(1)], vec![Constant(f64::NAN)], vec![Negate]]
        {
            assert!(Expression::new(program, 1).is_err());
        }
        assert!(Instruction::parse("log", 0.0).is_err() && Instruction::parse("channel", 0.5).is_err());
        assert_eq!(Instruction::parse("tanh", 0.0), Ok(Apply(Function::Tanh)));
    }
}
