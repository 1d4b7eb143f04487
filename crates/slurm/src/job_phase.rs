//! Where a job stands.

/// Where a job stands, as far as it matters to who has submitted it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobPhase {
    /// It waits.
    Pending,
    /// It has a node. States that are not known count as this one: nothing is submitted beside them.
    Running,
    /// It ends; it may be requeued then.
    Completing,
    /// It has ended and will not come back.
    Over,
}

impl JobPhase {
    /// That of a state in Slurm's words, as `RUNNING`.
    pub fn from_state(state: &str) -> Self {
        match state {
            "PENDING" | "REQUEUED" | "REQUEUE_FED" | "REQUEUE_HOLD" | "RESV_DEL_HOLD" | "SPECIAL_EXIT" => {
                Self::Pending
            }
            "COMPLETING" => Self::Completing,
            "BOOT_FAIL" | "CANCELLED" | "COMPLETED" | "DEADLINE" | "FAILED" | "LAUNCH_FAILED"
            | "NODE_FAIL" | "OUT_OF_MEMORY" | "PREEMPTED" | "RECONFIG_FAIL" | "REVOKED" | "TIMEOUT" => {
                Self::Over
            }
            _ => Self::Running,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_that_nobody_knows_is_that_of_a_living_job() {
        let expected = [
            ("PENDING", JobPhase::Pending),
            ("REQUEUE_HOLD", JobPhase::Pending),
            ("SUSPENDED", JobPhase::Running),
            ("CONFIGURING", JobPhase::Running),
            ("WHATEVER_COMES", JobPhase::Running),
            ("COMPLETING", JobPhase::Completing),
            ("NODE_FAIL", JobPhase::Over),
            ("TIMEOUT", JobPhase::Over),
        ];
        for (state, phase) in expected {
            assert_eq!(JobPhase::from_state(state), phase, "{state}");
        }
    }
}
