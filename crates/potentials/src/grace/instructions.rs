//! The vector instructions for which the passes over atoms are compiled.

/// A set of vector instructions that this processor supports.
///
/// Products are accumulated by fused multiply-add in the same order for every vector width, so results have the
/// same bits with all sets. Without hardware support, fused multiply-add is emulated and very slow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Instructions(InstructionSet);

/// Only [`Instructions::best`] and [`Instructions::all`], which query the processor, construct this.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum InstructionSet {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// The baseline of the architecture.
    Baseline,
}

/// A pass. Functions that it calls must be `inline(always)`; others are compiled for the baseline.
pub(crate) trait SimdPass {
    /// `wide` states that there are 32 registers of eight numbers.
    fn run(self, wide: bool);
}

impl Instructions {
    /// The fastest supported set.
    pub fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            let wide = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl");
            return Self(if wide { InstructionSet::Avx512 } else { InstructionSet::Avx2 });
        }
        Self(InstructionSet::Baseline)
    }

    /// All supported sets, fastest first.
    pub fn all() -> Vec<Self> {
        let sets = match Self::best().0 {
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => {
                vec![InstructionSet::Avx512, InstructionSet::Avx2, InstructionSet::Baseline]
            }
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => vec![InstructionSet::Avx2, InstructionSet::Baseline],
            InstructionSet::Baseline => vec![InstructionSet::Baseline],
        };
        sets.into_iter().map(Self).collect()
    }

    /// `"AVX-512"`, `"AVX2 with FMA"` or `"baseline"`.
    pub fn name(self) -> &'static str {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => "AVX-512",
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => "AVX2 with FMA",
            InstructionSet::Baseline => "baseline",
        }
    }

    /// Runs a pass, compiled for these instructions.
    #[allow(unsafe_code)] // The processor has them: `best` has asked.
    pub(crate) fn run(self, pass: impl SimdPass) {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => unsafe { x86::with_avx512(pass) },
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => unsafe { x86::with_avx2(pass) },
            InstructionSet::Baseline => pass.run(false),
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::SimdPass;

    #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
    pub fn with_avx512(pass: impl SimdPass) {
        pass.run(true);
    }

    #[target_feature(enable = "avx2,fma")]
    pub fn with_avx2(pass: impl SimdPass) {
        pass.run(false);
    }
}
