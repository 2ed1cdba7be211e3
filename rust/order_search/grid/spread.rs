//! Orders of visiting that spread any first part of them over the whole range.

/// Fractional part of the golden section: multiples of it spread evenly.
const GOLDEN: f64 = 0.618_033_988_75;

/// A place in [0, 1) of every index; neighbours lie far apart.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn spread(index: u64) -> f64 {
    (index as f64 * GOLDEN).fract()
}

/// Visits 0 … count−1 once each, spread over the whole range from the start.
pub(crate) fn visit(count: u64) -> impl Fn(u64) -> u64 {
    // The golden section spreads any prefix evenly; the next stride coprime with the count visits all.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    let mut stride = ((count as f64 * GOLDEN) as u64).max(1);
    while gcd(stride, count) != 1 {
        stride += 1;
    }
    move |i| {
        #[allow(clippy::cast_possible_truncation)]
        let index = (u128::from(i) * u128::from(stride) % u128::from(count)) as u64;
        index
    }
}

fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 {
        a
    } else {
        gcd(b, a % b)
    }
}
