//! Orders as affine functions of named free ones.

use std::collections::BTreeMap;

use crate::equation::{tidy, AffineOrder};

/// A number, or an affine function of free orders.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Order {
    /// Constant part.
    pub constant: f64,
    /// Weight of each free order, names rising, without zeros.
    pub weights: Vec<(String, f64)>,
}

impl Order {
    /// A number.
    ///
    /// ```
    /// use ftlm::estimation::joint_fit::order::Order;
    /// assert!(Order::free("alpha").is_single() && !Order::number(2.0).is_free());
    /// ```
    #[must_use]
    pub fn number(constant: f64) -> Self {
        Self { constant, weights: Vec::new() }
    }

    /// One free order.
    #[must_use]
    pub fn free(name: &str) -> Self {
        Self { constant: 0.0, weights: vec![(name.to_owned(), 1.0)] }
    }

    /// Free orders that this one depends on.
    pub fn names(&self) -> impl Iterator<Item = &String> {
        self.weights.iter().map(|(name, _)| name)
    }

    /// Whether it depends on free orders.
    #[must_use]
    pub fn is_free(&self) -> bool {
        !self.weights.is_empty()
    }

    /// Whether it is one free order and nothing else.
    #[must_use]
    pub fn is_single(&self) -> bool {
        self.constant == 0.0 && matches!(self.weights.as_slice(), [(_, 1.0)])
    }

    /// Its value where every free order has one; those that have none count 0.
    #[must_use]
    pub fn at(&self, value: impl Fn(&str) -> f64) -> f64 {
        self.constant + self.weights.iter().map(|(name, weight)| weight * value(name)).sum::<f64>()
    }

    /// The same with some free orders replaced by values.
    #[must_use]
    pub fn partly(&self, values: &BTreeMap<String, f64>) -> Self {
        let known = self.weights.iter().filter_map(|(name, weight)| values.get(name).map(|value| weight * value));
        let constant = tidy(self.constant + known.sum::<f64>());
        let weights = self.weights.iter().filter(|(name, _)| !values.contains_key(name)).cloned().collect();
        Self { constant, weights }
    }

    /// As the estimators take it, the free orders in this order.
    #[must_use]
    pub fn affine(&self, names: &[String]) -> AffineOrder {
        let weight = |name: &String| self.weights.iter().find(|(n, _)| n == name).map_or(0.0, |(_, weight)| *weight);
        AffineOrder { constant: self.constant, weights: names.iter().map(weight).collect() }
    }
}
