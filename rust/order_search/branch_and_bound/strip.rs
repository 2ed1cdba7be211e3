//! Coefficients on the two varying columns of all candidates of some rows of a slab.

/// Candidates of a row that are looked at side by side.
const LANES: usize = 4;
const PLACES: [f64; LANES] = [0.0, 1.0, 2.0, 3.0];

/// Coefficients on û and v̂ of all candidates of some rows of a slab.
#[derive(Default)]
pub(super) struct Strip {
    /// Their first row, and how many values a row has.
    pub(super) start: usize,
    /// See `start`.
    pub(super) len: usize,
    /// (p + q)/2, (p − q)/2 and 1 − B²; all of them 0 where that is next to nothing, or no number.
    pub(super) plus: Vec<f64>,
    pub(super) minus: Vec<f64>,
    pub(super) left: Vec<f64>,
    /// B, and products with the other columns one after the other, of a row.
    pub(super) product: Vec<f64>,
}

impl Strip {
    #[inline(always)]
    pub(super) fn at(&self, row: usize, value: usize) -> usize {
        (row - self.start) * self.len + value
    }

    /// How far from bilinear functions (p + q)/2 and (p − q)/2 run over a box, and the least 1 − B².
    #[inline(always)]
    pub(super) fn off(
        &self,
        [(u0, u1), (v0, v1)]: [(usize, usize); 2],
        [plus, minus]: [[f64; 4]; 2],
    ) -> ([f64; 2], f64) {
        let (mut far, mut left) = ([[0.0_f64; LANES]; 2], [f64::INFINITY; LANES]);
        let width = v1 - v0 + 1;
        let [down, across] = [(u0, u1), (v0, v1)].map(|(a, b)| if b > a { 2.0 / count(b - a) } else { 0.0 });
        for row in 0..=u1 - u0 {
            let s = count(row) * down - 1.0;
            let (x, y) = (plus[2] + plus[3] * s, minus[2] + minus[3] * s);
            let (first, second) = (plus[0] + plus[1] * s - x, minus[0] + minus[1] * s - y);
            let (x, y, start) = (x * across, y * across, self.at(u0 + row, v0));
            let plus = self.plus[start..start + width].chunks_exact(LANES);
            let minus = self.minus[start..start + width].chunks_exact(LANES);
            let lefts = self.left[start..start + width].chunks_exact(LANES);
            let rest = [plus.remainder(), minus.remainder(), lefts.remainder()];
            let mut place = PLACES;
            for ((plus, minus), lefts) in plus.zip(minus).zip(lefts) {
                for n in 0..LANES {
                    let a = (plus[n] - (first + x * place[n])).abs();
                    let b = (minus[n] - (second + y * place[n])).abs();
                    far[0][n] = if a > far[0][n] { a } else { far[0][n] };
                    far[1][n] = if b > far[1][n] { b } else { far[1][n] };
                    left[n] = if lefts[n] < left[n] { lefts[n] } else { left[n] };
                    place[n] += PLACES[LANES - 1] + 1.0;
                }
            }
            for n in 0..rest[0].len() {
                let a = (rest[0][n] - (first + x * place[n])).abs();
                let b = (rest[1][n] - (second + y * place[n])).abs();
                far[0][n] = if a > far[0][n] { a } else { far[0][n] };
                far[1][n] = if b > far[1][n] { b } else { far[1][n] };
                left[n] = if rest[2][n] < left[n] { rest[2][n] } else { left[n] };
            }
        }
        let most = |x: [f64; LANES]| x.into_iter().fold(0.0_f64, f64::max);
        ([most(far[0]), most(far[1])], left.into_iter().fold(f64::INFINITY, f64::min))
    }

    /// The least 1 − B² over a box, and the most of ‖y‖² that û and v̂ explain.
    #[inline(always)]
    pub(super) fn explained(&self, [(u0, u1), (v0, v1)]: [(usize, usize); 2], [y, z]: [&[f64]; 2]) -> (f64, f64) {
        let (mut left, mut most) = ([f64::INFINITY; LANES], [f64::NEG_INFINITY; LANES]);
        let width = v1 - v0 + 1;
        for row in u0..u1 + 1 {
            let (y, start) = (y[row], self.at(row, v0));
            let here = [&self.plus, &self.minus, &self.left].map(|from| &from[start..start + width]);
            let z = &z[v0..v0 + width];
            let mut at = 0;
            while at < width {
                let lanes = LANES.min(width - at);
                for n in 0..lanes {
                    let explained = here[0][at + n] * (y + z[at + n]) + here[1][at + n] * (y - z[at + n]);
                    most[n] = if explained > most[n] { explained } else { most[n] };
                    left[n] = if here[2][at + n] < left[n] { here[2][at + n] } else { left[n] };
                }
                at += lanes;
            }
        }
        (left.into_iter().fold(f64::INFINITY, f64::min), most.into_iter().fold(f64::NEG_INFINITY, f64::max))
    }
}

/// So many, to reckon with.
#[inline(always)]
#[allow(clippy::cast_precision_loss)]
pub(super) fn count(n: usize) -> f64 {
    n as f64
}
