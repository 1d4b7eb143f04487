//! The environment of a program that makes labels.
//!
//! Labellers inherit the environment of the shell or batch job that started them, including database passwords
//! and service tokens. A program that makes labels receives only the variables that such programs are known to
//! need and those that the user names.

use std::env;
use std::ffi::{OsStr, OsString};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Variables that every program receives.
const NAMES: &[&str] = &[
    "BASH_ENV",
    "CC",
    "CPATH",
    "CPLUS_INCLUDE_PATH",
    "CXX",
    "C_INCLUDE_PATH",
    "ENV",
    "FC",
    "HOME",
    "HOST",
    "HOSTNAME",
    "JAVA_HOME",
    "KRB5CCNAME",
    "LANG",
    "LANGUAGE",
    "LIBRARY_PATH",
    "LM_LICENSE_FILE",
    "LOADEDMODULES",
    "LOGNAME",
    "PATH",
    "PROJECT",
    "SCRATCH",
    "SHELL",
    "SSH_AUTH_SOCK",
    "TEMP",
    "TERM",
    "TMP",
    "TMPDIR",
    "TZ",
    "USER",
    "VIRTUAL_ENV",
    "WORK",
    "WORKDIR",
    "_LMFILES_",
];

/// Prefixes of further variables that every program receives.
const PREFIXES: &[&[&str]] = &[
    // Programs that make labels.
    &[
        "ABINIT",
        "ABI_",
        "AIMS",
        "ASE_",
        "CALMWALK_",
        "CASTEP",
        "CP2K",
        "DFTB",
        "ESPRESSO",
        "GAUSS",
        "GPAW",
        "MACE",
        "ORCA",
        "PSI",
        "QE_",
        "SIESTA",
        "VASP",
        "WANNIER",
        "XTB",
    ],
    // Languages and their packages.
    &[
        "CONDA",
        "JULIA",
        "MAMBA_",
        "NUMBA_",
        "NUMEXPR_",
        "PERL",
        "PIXI_",
        "PKG_CONFIG",
        "PYENV_",
        "PYTHON",
        "RUST_",
        "UV_",
        "XDG_",
    ],
    // Threads, memory and numerical libraries.
    &[
        "ARMPL_",
        "BLIS_",
        "FFTW",
        "FORT",
        "FOR_",
        "GFORTRAN_",
        "GOMP_",
        "GOTO_",
        "HDF5",
        "INTEL",
        "KMP_",
        "LC_",
        "LD_",
        "LIBXC",
        "MALLOC_",
        "MKL",
        "NETCDF",
        "OMP_",
        "ONEAPI",
        "OPENBLAS",
        "PGI",
        "SCALAPACK",
        "TBB_",
    ],
    // MPI and its networks.
    &[
        "FI_", "HCOLL", "HPCX", "HYDRA_", "IBV_", "I_MPI_", "MPI", "MV2_", "MVAPICH", "MVP_", "OMPI_",
        "OPAL_", "OPENMPI", "ORTE_", "PALS_", "PMI", "PRTE_", "PSM", "RDMAV_", "UCC_", "UCX_",
    ],
    // Accelerators and machine-learning frameworks.
    &[
        "ACC_", "AMD_", "CUDA", "CUDNN", "CUPY_", "GPU_", "HF_", "HIP", "HSA_", "JAX_", "NCCL_", "NV",
        "PYTORCH", "ROCBLAS", "ROCM", "ROCR_", "SYCL", "TF_", "TORCH", "TRITON_", "XLA_", "ZE_",
    ],
    // Batch systems.
    &["ALPS_", "LSB_", "LSF_", "PBS_", "SGE_", "SLURM"],
    // Modules and containers; shell functions exported for them.
    &[
        "APPTAINER",
        "BASH_FUNC_",
        "CRAY",
        "EASYBUILD",
        "EB",
        "LMOD",
        "MODULE",
        "PE_",
        "SINGULARITY",
        "SPACK",
        "_ModuleTable",
        "__LMOD",
    ],
];

/// Substrings of the names of variables that hold secrets.
const SECRETS: [&str; 10] = [
    "PASSWORD",
    "PASSWD",
    "PASSPHRASE",
    "SECRET",
    "TOKEN",
    "CREDENTIAL",
    "JWT",
    "API_KEY",
    "ACCESS_KEY",
    "PRIVATE_KEY",
];

/// The environment variables that a labeller passes to programs in addition to the standard ones.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(transparent)]
pub struct PassedEnvironment {
    /// Names, and prefixes followed by `*`.
    #[schemars(inner(regex(pattern = r"^[^*= ]+\*?$")))]
    patterns: Vec<String>,
}

impl PassedEnvironment {
    /// Passes these variables; `MYCODE_*` matches all names with the prefix `MYCODE_`.
    pub fn new(patterns: Vec<String>) -> Self {
        Self { patterns }
    }

    /// Whether there are no patterns.
    pub fn is_empty(&self) -> bool {
        self.patterns.is_empty()
    }

    /// The first pattern that is neither a name nor a prefix.
    pub fn invalid_pattern(&self) -> Option<&str> {
        let is_name = |pattern: &str| {
            let name = pattern.strip_suffix('*').unwrap_or(pattern);
            !name.is_empty() && !name.contains(['*', '=', '\0', ' '])
        };
        self.patterns.iter().map(String::as_str).find(|pattern| !is_name(pattern))
    }

    /// The variables of the current process that a program receives.
    pub fn from_current_process(&self) -> impl Iterator<Item = (OsString, OsString)> {
        env::vars_os().filter(|(name, _)| self.passes(name))
    }

    /// Whether programs receive this variable. A name that suggests a secret must be listed in full.
    fn passes(&self, name: &OsStr) -> bool {
        // All known names are UTF-8.
        let Some(name) = name.to_str() else { return false };
        let begins = |begin: &str| name.starts_with(begin);
        let mut named = self.patterns.iter();
        let allowed = NAMES.contains(&name) || PREFIXES.iter().copied().flatten().any(|begin| begins(begin));
        let matched = self.patterns.iter().filter_map(|pattern| pattern.strip_suffix('*')).any(begins);
        named.any(|pattern| pattern == name) || ((allowed || matched) && !is_secret(name))
    }
}

fn is_secret(name: &str) -> bool {
    let name = name.to_uppercase();
    SECRETS.iter().any(|part| name.contains(part))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passes(patterns: &[&str], name: &str) -> bool {
        let patterns = patterns.iter().map(|pattern| (*pattern).to_owned()).collect();
        PassedEnvironment::new(patterns).passes(OsStr::new(name))
    }

    #[test]
    fn programs_get_what_they_need_and_no_secret() {
        let needed = [
            "PATH",
            "HOME",
            "LD_LIBRARY_PATH",
            "OMP_NUM_THREADS",
            "I_MPI_PMI_LIBRARY",
            "SLURM_JOB_ID",
            "SLURMD_NODENAME",
            "CUDA_VISIBLE_DEVICES",
            "CONDA_PREFIX",
            "PYTHONPATH",
            "GPAW_SETUP_PATH",
            "BASH_FUNC_module%%",
            "EBROOTVASP",
            "LC_ALL",
        ];
        for name in needed {
            assert!(passes(&[], name), "{name}");
        }
        let secret = [
            "PGPASSWORD",
            "PGUSER",
            "SLURM_JWT",
            "HF_TOKEN",
            "AWS_SECRET_ACCESS_KEY",
            "MY_SITE",
            "https_proxy",
        ];
        for name in secret {
            assert!(!passes(&[], name), "{name}");
        }
    }

    #[test]
    fn users_name_further_variables() {
        assert!(passes(&["MY_SITE"], "MY_SITE") && !passes(&["MY_SITE"], "MY_SITES"));
        assert!(passes(&["MY_*"], "MY_SITE") && !passes(&["MY_*"], "MY_TOKEN"));
        assert!(passes(&["MY_TOKEN"], "MY_TOKEN"));
        let fault = |pattern: &str| {
            PassedEnvironment::new(vec![pattern.to_owned()]).invalid_pattern().map(str::to_owned)
        };
        assert_eq!((fault("MY_*"), fault("A")), (None, None));
        for wrong in ["", "*", "A*B", "A=1", "A B"] {
            assert_eq!(fault(wrong).as_deref(), Some(wrong));
        }
    }
}
