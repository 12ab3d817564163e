use pulp::{Scalar, Simd, WithSimd};

/// Number of lanes in the widest registers, those of AVX-512.
pub(super) const MAX_LANES: usize = 8;

/// The instruction set that the solver uses. All give the same transport to rounding; with one level it is the same
/// to the bit for any number of threads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SimdLevel {
    /// Plain floating point: one pixel at a time.
    Portable,
    /// x86-64 with AVX2 and FMA: four pixels at a time.
    Avx2,
    /// x86-64 with AVX-512: eight pixels at a time.
    Avx512,
}

impl SimdLevel {
    /// All levels that this machine supports, fastest last.
    pub fn available() -> Vec<Self> {
        [Self::Portable, Self::Avx2, Self::Avx512].into_iter().filter(|level| level.is_available()).collect()
    }

    /// The fastest level that this machine supports.
    pub fn best() -> Self {
        Self::available().pop().unwrap_or(Self::Portable)
    }

    /// The name used in reports.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "AVX2",
            Self::Avx512 => "AVX-512",
        }
    }

    #[cfg(target_arch = "x86_64")]
    fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            Self::Avx2 => pulp::x86::V3::try_new().is_some(),
            Self::Avx512 => pulp::x86::V4::try_new().is_some(),
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn is_available(self) -> bool {
        self == Self::Portable
    }

    /// Runs `op` with these instructions, or with the portable ones if the machine does not support them.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn run<Op: WithSimd>(self, op: Op) -> Op::Output {
        match (self, pulp::x86::V3::try_new(), pulp::x86::V4::try_new()) {
            (Self::Avx512, _, Some(simd)) => Simd::vectorize(simd, op),
            (Self::Avx2, Some(simd), _) => Simd::vectorize(simd, op),
            _ => Simd::vectorize(Scalar, op),
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    pub(super) fn run<Op: WithSimd>(self, op: Op) -> Op::Output {
        Simd::vectorize(Scalar, op)
    }
}
