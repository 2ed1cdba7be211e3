//! Powers and logarithms of the integers below m. They are computed for primes and combined for other integers.

use std::cell::RefCell;
use std::sync::Arc;
use std::thread::LocalKey;

use crate::parallel::ForkSafeLock;

/// Return `n^exponent` for n = 0 … m−1, with 0 for n = 0. Only primes require the power function. Every other integer
/// requires one product. The relative error grows by ε/2 per prime factor. Integers below 2^20 have at most 19 factors.
pub(crate) fn integer_powers(exponent: f64, m: usize) -> Vec<f64> {
    let (divisors, power) = (least_divisors(m), powers_of_primes(exponent, m));
    let mut powers = vec![0.0; m];
    for n in 1..m {
        let divisor = divisors[n] as usize;
        powers[n] = if n == 1 {
            1.0
        } else if divisor == n {
            power(n)
        } else {
            powers[divisor] * powers[n / divisor]
        };
    }
    powers
}

/// Return `(2k+1)^exponent` for k = 0 … m−1, computed as in [`integer_powers`].
pub(crate) fn odd_powers(exponent: f64, m: usize) -> Vec<f64> {
    let (divisors, power) = (least_divisors(2 * m), powers_of_primes(exponent, 2 * m));
    let mut powers = vec![1.0; m];
    for k in 1..m {
        let n = 2 * k + 1;
        let divisor = divisors[n] as usize;
        powers[k] = if divisor == n { power(n) } else { powers[divisor / 2] * powers[n / divisor / 2] };
    }
    powers
}

/// Logarithm in double-double precision: the rounded value and its error.
type Logarithm = (f64, f64);

/// Return a function that computes p^e for a prime p < m, with e = `exponent`. It uses ln p and is accurate to about
/// 1.5 ε. An exponential takes a third of the time of `pow`.
///
/// For an integer e it uses `pow`, which is exact if the power is representable.
#[allow(clippy::cast_precision_loss)]
fn powers_of_primes(exponent: f64, m: usize) -> impl Fn(usize) -> f64 {
    let logarithms = if exponent.fract() == 0.0 { None } else { Some(prime_logarithms(m)) };
    move |prime| match &logarithms {
        None => libm::pow(prime as f64, exponent),
        Some(logarithms) => {
            let (high, low) = logarithms[prime];
            let (product, rounding_error) = exact_product(high, exponent);
            let value = libm::exp(product);
            value + value * (rounding_error + low * exponent)
        }
    }
}

/// Return the rounded product a·b and its rounding error (Dekker, doi:10.1007/BF01397083). There must be no overflow or
/// underflow.
fn exact_product(a: f64, b: f64) -> (f64, f64) {
    const SPLITTING_FACTOR: f64 = 134_217_729.0;
    let split = |x: f64| {
        let high = SPLITTING_FACTOR * x - (SPLITTING_FACTOR * x - x);
        (high, x - high)
    };
    let product = a * b;
    let ((a, c), (b, d)) = (split(a), split(b));
    (product, ((a * b - product) + a * d + c * b) + c * d)
}

/// Return the rounded sum a + b and its rounding error.
fn exact_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let part = sum - a;
    (sum, (a - (sum - part)) + (b - part))
}

/// Growing table that all threads share. A thread uses a separate table if the lock is not available.
struct Table<T: 'static> {
    /// Table that all threads share.
    shared: &'static ForkSafeLock<Values<T>>,
    /// Table of this thread.
    thread_values: &'static LocalKey<RefCell<Values<T>>>,
    /// Function that computes a table with a given number of values.
    make: fn(usize) -> Vec<T>,
}

type Values<T> = Option<Arc<Vec<T>>>;

impl<T> Table<T> {
    /// Return a table with at least m values.
    fn of(&self, m: usize) -> Arc<Vec<T>> {
        let long_enough = |values: &Values<T>| values.as_ref().filter(|values| values.len() >= m).map(Arc::clone);
        let thread_values = || self.thread_values.with_borrow(long_enough);
        if let Some(values) = thread_values().or_else(|| self.shared.with(|values| long_enough(values)).flatten()) {
            return values;
        }
        let table = Arc::new((self.make)(m.next_power_of_two()));
        // The caller drops the replaced table outside the lock.
        let cached = self.shared.with(|values| {
            let longer = values.as_ref().is_none_or(|values| values.len() < table.len());
            longer.then(|| values.replace(Arc::clone(&table)))
        });
        if cached.is_none() {
            self.thread_values.set(Some(Arc::clone(&table)));
        }
        table
    }
}

/// Return the least prime divisor of each n < m. The table may be longer.
#[allow(clippy::cast_possible_truncation)]
fn least_divisors(m: usize) -> Arc<Vec<u32>> {
    static SHARED_TABLE: ForkSafeLock<Values<u32>> = ForkSafeLock::new(None);
    thread_local!(static THREAD_TABLE: RefCell<Values<u32>> = const { RefCell::new(None) });
    let make = |len| {
        let mut divisors: Vec<u32> = (0..len as u32).collect();
        let mut prime = 2;
        while prime * prime < len {
            if divisors[prime] as usize == prime {
                for multiple in (prime * prime..len).step_by(prime) {
                    if divisors[multiple] as usize == multiple {
                        divisors[multiple] = prime as u32;
                    }
                }
            }
            prime += 1;
        }
        divisors
    };
    Table { shared: &SHARED_TABLE, thread_values: &THREAD_TABLE, make }.of(m)
}

/// Return the logarithms ln n in double-double precision for n < m, with 0 for n = 0. The table may be longer.
///
/// The logarithm of a prime p is ln(p − 1) + 2 artanh(1/(2p − 1)). For another integer it is the sum over the prime
/// factors.
#[allow(clippy::cast_precision_loss)]
fn prime_logarithms(m: usize) -> Arc<Vec<Logarithm>> {
    static SHARED_TABLE: ForkSafeLock<Values<Logarithm>> = ForkSafeLock::new(None);
    thread_local!(static THREAD_TABLE: RefCell<Values<Logarithm>> = const { RefCell::new(None) });
    let make = |len| {
        let divisors = least_divisors(len);
        let add = |(high, low): Logarithm, (other, other_low): Logarithm| {
            let (sum, rounding_error) = exact_sum(high, other);
            exact_sum(sum, rounding_error + (low + other_low))
        };
        let mut logarithms = vec![(0.0, 0.0); len];
        for n in 2..len {
            let divisor = divisors[n] as usize;
            logarithms[n] = if n == 2 {
                (std::f64::consts::LN_2, 2.319_046_813_846_299_6e-17)
            } else if divisor == n {
                let odd = (2 * n - 1) as f64;
                let first = 1.0 / odd;
                let (product, rounding_error) = exact_product(first, odd);
                let square = first * first;
                // The truncated part of the series is below 1e−19.
                let series_tail = (1..13).rev().fold(0.0, |sum, k| (sum + 1.0 / f64::from(2 * k + 1)) * square);
                let low = ((1.0 - product) - rounding_error) / odd + first * series_tail;
                add(logarithms[n - 1], exact_sum(2.0 * first, 2.0 * low))
            } else {
                add(logarithms[divisor], logarithms[n / divisor])
            };
        }
        logarithms
    };
    Table { shared: &SHARED_TABLE, thread_values: &THREAD_TABLE, make }.of(m)
}

/// Return the logarithms ln n for n < m, with 0 for n = 0. The table may be longer.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn integer_logarithms(m: usize) -> Arc<Vec<f64>> {
    static SHARED_TABLE: ForkSafeLock<Values<f64>> = ForkSafeLock::new(None);
    thread_local!(static THREAD_TABLE: RefCell<Values<f64>> = const { RefCell::new(None) });
    let make = |len| (0..len).map(|n: usize| libm::log(n.max(1) as f64)).collect();
    Table { shared: &SHARED_TABLE, thread_values: &THREAD_TABLE, make }.of(m)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn locked_cache_does_not_block_tables() {
        static SHARED_TABLE: ForkSafeLock<Values<usize>> = ForkSafeLock::new(None);
        thread_local!(static THREAD_TABLE: RefCell<Values<usize>> = const { RefCell::new(None) });
        let table = Table { shared: &SHARED_TABLE, thread_values: &THREAD_TABLE, make: |len| (0..len).collect() };
        let (first, second) = SHARED_TABLE.hold_during(|| (table.of(5), table.of(8)));
        assert_eq!(*first, [0, 1, 2, 3, 4, 5, 6, 7]);
        assert!(Arc::ptr_eq(&first, &second), "made once");
        let longer = table.of(9);
        assert_eq!(longer.len(), 16);
        // Another thread takes what is shared, and a shorter one made meanwhile replaces nothing.
        std::thread::scope(|scope| {
            scope.spawn(|| assert!(Arc::ptr_eq(&table.of(16), &longer)));
        });
    }
}
