//! What an order search takes one by one.

use std::collections::BTreeSet;

use crate::estimation::joint_fit::order::Order;
use crate::estimation::joint_fit::structure::{Equation, Structure};

/// What an order search takes one by one: equations that share no free order do not wait for one another.
///
/// Equations that an order law ties stay together; any other equation is by itself. Equations without free orders are
/// left out.
pub(super) fn parts(structure: &Structure) -> Vec<Structure> {
    let mut groups: Vec<(BTreeSet<&String>, Vec<&Equation>)> = Vec::new();
    for item in &structure.equations {
        let own: BTreeSet<&String> = item.orders().flat_map(Order::names).collect();
        let (mut names, mut together, mut apart) = (own.clone(), vec![item], Vec::new());
        for (others, equations) in groups {
            if own.is_disjoint(&others) {
                apart.push((others, equations));
            } else {
                names.extend(others);
                together = [equations, together].concat();
            }
        }
        apart.push((names, together));
        groups = apart;
    }
    let ordered = groups.into_iter().filter(|(names, _)| !names.is_empty());
    let part = |(_, equations): (_, Vec<&Equation>)| Structure {
        equations: equations.into_iter().cloned().collect(),
        laws: Vec::new(),
        ..structure.clone()
    };
    ordered.map(part).collect()
}
