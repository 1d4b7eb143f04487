//! Which vector instructions the passes over atoms are compiled for.

/// A choice of vector instructions that this processor has.
///
/// Products are added with one rounding, and in the same order whatever the width of vectors, so that results have the same
/// bits on all of them. A processor without fused multiply-adds works them out in software, very slowly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Instructions(Set);

/// Made by [`Instructions::best`] and [`Instructions::all`] alone, which ask the processor first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Set {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// What every processor of the architecture has.
    Baseline,
}

/// Some work; what it calls must be `inline(always)`, or it is compiled for the baseline.
pub(crate) trait Pass {
    /// `wide` says whether there are 32 registers of eight numbers.
    fn run(self, wide: bool);
}

impl Instructions {
    /// The fastest that this processor has.
    pub fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            let wide = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl");
            return Self(if wide { Set::Avx512 } else { Set::Avx2 });
        }
        Self(Set::Baseline)
    }

    /// All that this processor has, the fastest first.
    pub fn all() -> Vec<Self> {
        let sets = match Self::best().0 {
            #[cfg(target_arch = "x86_64")]
            Set::Avx512 => vec![Set::Avx512, Set::Avx2, Set::Baseline],
            #[cfg(target_arch = "x86_64")]
            Set::Avx2 => vec![Set::Avx2, Set::Baseline],
            Set::Baseline => vec![Set::Baseline],
        };
        sets.into_iter().map(Self).collect()
    }

    /// Runs a pass, compiled for these instructions.
    #[allow(unsafe_code)] // The processor has them: `best` has asked.
    pub(crate) fn run(self, pass: impl Pass) {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Set::Avx512 => unsafe { x86::with_avx512(pass) },
            #[cfg(target_arch = "x86_64")]
            Set::Avx2 => unsafe { x86::with_avx2(pass) },
            Set::Baseline => pass.run(false),
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Pass;

    #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
    pub fn with_avx512(pass: impl Pass) {
        pass.run(true);
    }

    #[target_feature(enable = "avx2,fma")]
    pub fn with_avx2(pass: impl Pass) {
        pass.run(false);
    }
}
