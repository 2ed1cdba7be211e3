//! The starred transforms of samples, computed from Laplace transforms by Poisson's summation formula.
//!
//! Samples f(kh) of a signal f with Laplace transform F have the starred transform F*(s) = Σ f(kh) e^{−skh} = 1/h Σ_n
//! F(s + 2πi n/h). The sample at a jump is the mean of both sides. For Re s = σ > 0, F* is the discrete Fourier
//! transform of the samples times e^{−σkh}, which are periodic up to e^{−σLh} over L samples. The samples of a function
//! with any powers of s thus have an error of only about 1e−10, without a grid of pulses. A convolution with
//! zero-order-hold inputs is a product of two transforms.
//!
//! The alias terms n ≠ 0 are smooth in the base band |Im s| ≤ π/h. They are therefore evaluated at Chebyshev nodes and
//! interpolated. The terms of large |n| are summed by an Euler–Maclaurin integral, whose constant follows from f(0).

use std::f64::consts::PI;

use crate::fft::{self, Bin, Plan, Workspace};

/// Product of the damping σ and the duration T. It balances the wrap-around error e^{−2σT} and the rounding error
/// e^{σT} ε, both of which are 4e−11.
const DAMPING_DURATIONS: f64 = 12.0;
/// Number of panels of the base band (frequencies up to the Nyquist frequency), each with [`PANEL_NODES`] Chebyshev
/// nodes. The error is about 34^−8 = 6e−13 if no pole is near the Nyquist frequency (Bernstein ellipse of radius 34 of
/// the outermost panel).
const BAND_PANEL_COUNT: usize = 8;
/// Number of Chebyshev nodes in each panel of the base band (frequencies up to the Nyquist frequency).
const PANEL_NODES: usize = 8;
/// Index n of the first alias term F(s + 2πi n/h) that an integral replaces. F is a Laplace transform, and h the
/// sampling interval.
const DIRECT_ALIAS_COUNT: usize = 32;
/// Coefficient of the third difference in the midpoint Euler–Maclaurin formula.
const THIRD_DIFFERENCE: f64 = 17.0 / 5760.0;
/// Gauss–Legendre quadrature rule on [0, 1] as pairs (point, weight).
const LEGENDRE_RULE: [(f64, f64); 4] = [
    (0.069_431_844_202_973_71, 0.173_927_422_568_726_93),
    (0.330_009_478_207_571_87, 0.326_072_577_431_273_07),
    (0.669_990_521_792_428_1, 0.326_072_577_431_273_07),
    (0.930_568_155_797_026_3, 0.173_927_422_568_726_93),
];

/// The starred transform Σ f(kh) e^{−skh} of uniform samples f(kh), on the line Re s = σ.
pub(crate) struct StarredTransform {
    /// Sampling interval h \[s\].
    step: f64,
    plan: Plan,
    /// Damping factor e^{−σkh} of sample k, with the damping σ and the sampling interval h.
    damping: Vec<f64>,
    /// Logarithm ln s of the Laplace variable at each frequency bin.
    logarithms: Vec<Bin>,
    /// Index of the first bin of each panel of the base band, followed by the total number of bins.
    panels: Vec<usize>,
    /// Damping σ, the real part of s \[1/s\].
    damping_rate: f64,
    /// Weight of each alias term and its point s, by interpolation node.
    aliases: Vec<Vec<(f64, LaplacePoint)>>,
}

/// Laplace variable s, with its logarithm.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LaplacePoint {
    /// Laplace variable s \[1/s\].
    pub(crate) s: Bin,
    /// Logarithm ln s.
    pub(crate) logarithm: Bin,
}

impl LaplacePoint {
    pub(crate) fn new(s: Bin) -> Self {
        Self { s, logarithm: Bin::new(libm::log(s.re.hypot(s.im)), libm::atan2(s.im, s.re)) }
    }

    /// Return the Laplace transform s^−η of η-fold integration.
    pub(crate) fn integration(self, eta: f64) -> Bin {
        let modulus = libm::exp(-eta * self.logarithm.re);
        let (sine, cosine) = libm::sincos(-eta * self.logarithm.im);
        Bin::new(modulus * cosine, modulus * sine)
    }
}

impl StarredTransform {
    /// Prepare starred transforms Σ f(kh) e^{−skh} of `rows` samples f(kh) with the sampling interval h = `step` \[s\].
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(crate) fn new(rows: usize, step: f64) -> Self {
        let plan = fft::plan(fft::fast_length(2 * rows));
        let sigma = DAMPING_DURATIONS / (rows as f64 * step);
        let point = |omega: f64| LaplacePoint::new(Bin::new(sigma, omega));
        let spacing = 2.0 * PI / (plan.len() as f64 * step);
        let width = PI / step / BAND_PANEL_COUNT as f64;
        let panels = (0..=BAND_PANEL_COUNT).map(|p| {
            if p == BAND_PANEL_COUNT {
                plan.bins()
            } else {
                (p as f64 * width / spacing).ceil() as usize
            }
        });
        let period = 2.0 * PI / step;
        let mut weights = vec![1.0; DIRECT_ALIAS_COUNT];
        weights.extend([0.0; 2]);
        weights[DIRECT_ALIAS_COUNT] += 1.0 / 24.0 + 3.0 * THIRD_DIFFERENCE;
        weights[DIRECT_ALIAS_COUNT - 1] -= 1.0 / 24.0 + 3.0 * THIRD_DIFFERENCE;
        weights[DIRECT_ALIAS_COUNT + 1] -= THIRD_DIFFERENCE;
        weights[DIRECT_ALIAS_COUNT - 2] += THIRD_DIFFERENCE;
        let edge = (DIRECT_ALIAS_COUNT as f64 - 0.5) * period;
        let node = |node_index: usize| {
            let omega =
                width * (0.5 + (node_index / PANEL_NODES) as f64 + 0.5 * chebyshev_node(node_index % PANEL_NODES));
            let direct = weights
                .iter()
                .enumerate()
                .skip(1)
                .flat_map(|(n, &weight)| [1.0, -1.0].map(|sign| (weight, point(omega + sign * n as f64 * period))));
            // d/dω of the integral from the edge to infinity is the function at the edge.
            let tail = LEGENDRE_RULE.iter().flat_map(|&(place, weight)| {
                [1.0, -1.0].map(|sign| (-sign * weight * omega / period, point(place * omega + sign * edge)))
            });
            direct.chain(tail).collect()
        };
        Self {
            step,
            damping: (0..rows).map(|k| libm::exp(-sigma * step * k as f64)).collect(),
            logarithms: (0..plan.bins()).map(|j| point(j as f64 * spacing).logarithm).collect(),
            damping_rate: sigma,
            panels: panels.collect(),
            aliases: (0..BAND_PANEL_COUNT * PANEL_NODES).map(node).collect(),
            plan,
        }
    }

    /// Number of frequency bins.
    pub(crate) fn bins(&self) -> usize {
        self.logarithms.len()
    }

    /// Return the starred transform Σ f(kh) e^{−skh} of samples f(kh), one value per frequency bin. h is the sampling
    /// interval.
    pub(crate) fn transform(&self, samples: impl Iterator<Item = f64>) -> Vec<Bin> {
        let mut time: Vec<f64> = samples.zip(&self.damping).map(|(v, damping)| v * damping).collect();
        time.resize(self.plan.len(), 0.0);
        let mut spectrum = vec![Bin::default(); self.plan.bins()];
        self.plan.transform(&mut time, &mut spectrum, &mut Workspace::new());
        spectrum
    }

    /// Return the samples with the given starred transform, the inverse of [`Self::transform`].
    pub(crate) fn samples(&self, mut spectrum: Vec<Bin>) -> Vec<f64> {
        let mut time = vec![0.0; self.plan.len()];
        self.plan.inverse(&mut spectrum, &mut time, &mut Workspace::new());
        time.truncate(self.damping.len());
        time.iter_mut().zip(&self.damping).for_each(|(v, damping)| *v /= damping);
        time
    }

    /// Return the starred transforms Σ f(kh) e^{−skh} of functions f, one value per frequency bin. `functions(s, out)`
    /// writes their Laplace transforms at s to `out`, and `starts` contains their values at t = 0. h is the sampling
    /// interval.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn spectra(&self, starts: &[f64], mut functions: impl FnMut(LaplacePoint, &mut [Bin])) -> Vec<Vec<Bin>> {
        let count = starts.len();
        let mut values = vec![Bin::default(); count];
        let mut sums = vec![[Bin::default(); BAND_PANEL_COUNT * PANEL_NODES]; count];
        for (node_index, aliases) in self.aliases.iter().enumerate() {
            for &(weight, point) in aliases {
                functions(point, &mut values);
                sums.iter_mut().zip(&values).for_each(|(sum, value)| sum[node_index] += value * weight);
            }
        }
        let mut spectra = vec![Vec::with_capacity(self.logarithms.len()); count];
        let spacing = 2.0 * PI / (self.plan.len() as f64 * self.step);
        for (j, &logarithm) in self.logarithms.iter().enumerate() {
            functions(LaplacePoint { s: Bin::new(self.damping_rate, j as f64 * spacing), logarithm }, &mut values);
            spectra.iter_mut().zip(&values).for_each(|(spectrum, &value)| spectrum.push(value));
        }
        for ((spectrum, sums), start) in spectra.iter_mut().zip(&sums).zip(starts) {
            self.add_aliases(spectrum, sums);
            let (bins, inner_sum) =
                (spectrum.len(), spectrum[1..spectrum.len() - 1].iter().map(|v| 2.0 * v.re).sum::<f64>());
            let mean = (spectrum[0].re + inner_sum + spectrum[bins - 1].re) / self.plan.len() as f64;
            let scale = 1.0 / self.step;
            spectrum.iter_mut().for_each(|v| *v = (*v - mean) * scale + start);
        }
        spectra
    }

    /// Add the alias terms n ≠ 0, interpolated from their `sums` at the nodes, to the term n = 0 of a function.
    #[allow(clippy::cast_precision_loss)]
    fn add_aliases(&self, spectrum: &mut [Bin], sums: &[Bin]) {
        let node_spacing = 2.0 * BAND_PANEL_COUNT as f64 / (self.plan.len() / 2) as f64;
        for (p, nodes) in sums.chunks_exact(PANEL_NODES).enumerate() {
            // Chebyshev coefficients.
            let mut c = [Bin::default(); PANEL_NODES];
            for (m, c) in c.iter_mut().enumerate() {
                let scale = if m == 0 { 1.0 } else { 2.0 } / PANEL_NODES as f64;
                for (k, value) in nodes.iter().enumerate() {
                    *c += value * (scale * libm::cos(m as f64 * node_angle(k)));
                }
            }
            let first = self.panels[p];
            for (j, value) in (first..).zip(&mut spectrum[first..self.panels[p + 1]]) {
                let x = j as f64 * node_spacing - (2 * p + 1) as f64;
                let (mut previous, mut current) = (Bin::default(), Bin::default());
                for c in c[1..].iter().rev() {
                    (previous, current) = (current, current * (2.0 * x) - previous + c);
                }
                *value += current * x - previous + c[0];
            }
        }
    }
}

/// Return the angle of Chebyshev node k.
#[allow(clippy::cast_precision_loss)]
fn node_angle(k: usize) -> f64 {
    (2 * k + 1) as f64 * PI / (2 * PANEL_NODES) as f64
}

/// Return Chebyshev node k on [−1, 1].
fn chebyshev_node(k: usize) -> f64 {
    libm::cos(node_angle(k))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Return samples of the step response of a transfer function without direct feedthrough.
    fn step_response(rows: usize, step: f64, function: impl Fn(LaplacePoint) -> Bin) -> Vec<f64> {
        let transform = StarredTransform::new(rows, step);
        let spectra = transform.spectra(&[0.0], |point, values| {
            values[0] = function(point) * point.integration(1.0);
        });
        spectra.into_iter().map(|spectrum| transform.samples(spectrum)).next().unwrap_or_default()
    }

    fn distance(actual: &[f64], exact: impl Fn(f64) -> f64, step: f64) -> f64 {
        actual.iter().enumerate().map(|(k, v)| (v - exact(k as f64 * step)).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn step_responses_of_closed_form_are_exact() {
        for (rows, step) in [(200, 0.05), (5000, 0.01)] {
            // 1/(s + 3), 9/(s² + 0.6 s + 9), 1/(s^0.5 + 1) and s^−0.01.
            let fall = step_response(rows, step, |s| (s.integration(-1.0) + 3.0).inv());
            assert!(distance(&fall, |t| (1.0 - (-3.0 * t).exp()) / 3.0, step) < 1e-9);
            let (decay, omega) = (0.3, (9.0_f64 - 0.09).sqrt());
            let ring =
                step_response(rows, step, |s| (s.integration(-2.0) + s.integration(-1.0) * 0.6 + 9.0).inv() * 9.0);
            let exact = |t: f64| 1.0 - (-decay * t).exp() * ((omega * t).cos() + decay / omega * (omega * t).sin());
            assert!(distance(&ring, exact, step) < 1e-9);
            let slow = step_response(rows, step, |s| s.integration(0.01));
            let gamma = libm::tgamma(1.01);
            assert!(distance(&slow, |t| t.powf(0.01) / gamma, step) < 1e-9);
            let half = step_response(rows, step, |s| (s.integration(-0.5) + 1.0).inv());
            let exact = |t: f64| 1.0 - t.exp() * libm::erfc(t.sqrt());
            assert!(distance(&half[..200], exact, step) < 1e-9);
        }
    }

    #[test]
    fn transform_and_inverse_return_the_samples() {
        let samples: Vec<f64> = (0..77).map(|k| f64::from(k).sin()).collect();
        let transform = StarredTransform::new(77, 0.1);
        let back = transform.samples(transform.transform(samples.iter().copied()));
        assert!(back.iter().zip(&samples).all(|(a, b)| (a - b).abs() < 1e-9));
    }
}
