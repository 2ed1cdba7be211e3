//! Leaps along the bottom of a curved valley, where steps that lower the cost are short beside the way that is left.
//!
//! Numbers that data hardly tell apart make a valley that bends: steps follow its bottom one short chord after another, all
//! in one direction. What they came to together is repeated a few times over in one leap, from the end of which ordinary
//! steps lead down to the bottom again; where they do not soon end below the point that was left, the search goes on there.

/// Steps on which a leap is founded.
const STEPS: usize = 4;
/// Of the length of these steps the share that their sum has at least: else they lead nowhere together.
const STRAIGHT: f64 = 0.8;
/// Share of the cost that a step lowers at most: who gets on needs no leap.
const CREEPS: f64 = 1e-3;
/// Evaluations within which a leap must come to something.
const PATIENCE: usize = 6;
/// How often the sum of the steps is repeated, at first and at most.
const REACH: f64 = 2.0;
const FARTHEST: f64 = 16.0;

/// The last steps of a search, and the point that it left by a leap.
pub(crate) struct Valley<P> {
    steps: Vec<Vec<f64>>,
    reach: f64,
    /// Where it leapt from, what it cost there, and after how many evaluations.
    left: Option<(P, f64, usize)>,
}

impl<P> Valley<P> {
    /// Nothing known.
    pub(crate) fn new() -> Self {
        Self { steps: Vec::new(), reach: REACH, left: None }
    }

    /// Takes a step, in coordinates, that lowered the cost by a share of it.
    pub(crate) fn moved(&mut self, step: &[f64], gain: f64) {
        if gain > CREEPS {
            self.steps.clear();
        } else {
            self.steps.push(step.to_vec());
        }
    }

    /// The leap that the last steps ask for, if that many evaluations are left for it.
    pub(crate) fn leap(&mut self, evaluations: usize) -> Option<Vec<f64>> {
        if self.left.is_some() || self.steps.len() < STEPS || evaluations <= PATIENCE {
            return None;
        }
        let last = self.steps.split_off(self.steps.len() - STEPS);
        self.steps.clear();
        let norm = |v: &[f64]| v.iter().map(|s| s * s).sum::<f64>().sqrt();
        let sum: Vec<f64> = (0..last[0].len()).map(|i| last.iter().map(|step| step[i]).sum()).collect();
        let straight = norm(&sum) >= STRAIGHT * last.iter().map(|step| norm(step)).sum::<f64>();
        straight.then(|| sum.iter().map(|s| self.reach * s).collect())
    }

    /// The search leapt from this point, at this cost.
    pub(crate) fn left(&mut self, from: P, cost: f64, evaluations: usize) {
        self.left = Some((from, cost, evaluations));
    }

    /// A leap led nowhere.
    pub(crate) fn fell(&mut self) {
        self.reach = (0.5 * self.reach).max(1.0);
        self.steps.clear();
    }

    /// The point that was left, where the leap from it has come to nothing; a search that ends has no time left.
    pub(crate) fn outcome(&mut self, cost: f64, evaluations: usize, ends: bool) -> Option<P> {
        let (from, least, since) = self.left.take()?;
        if cost < least {
            self.reach = (2.0 * self.reach).min(FARTHEST);
            self.steps.clear();
            return None;
        }
        if ends || evaluations >= since + PATIENCE {
            self.fell();
            return Some(from);
        }
        self.left = Some((from, least, since));
        None
    }
}
