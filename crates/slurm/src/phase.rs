//! Where a job stands.

/// Where a job stands, as far as it matters to who has submitted it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// It waits.
    Pending,
    /// It has a node. States that are not known count as this one: nothing is submitted beside them.
    Running,
    /// It ends; it may be requeued then.
    Completing,
    /// It has ended and will not come back.
    Over,
}

impl Phase {
    /// That of a state in Slurm's words, as `RUNNING`.
    pub fn of(state: &str) -> Self {
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
            ("PENDING", Phase::Pending),
            ("REQUEUE_HOLD", Phase::Pending),
            ("SUSPENDED", Phase::Running),
            ("CONFIGURING", Phase::Running),
            ("WHATEVER_COMES", Phase::Running),
            ("COMPLETING", Phase::Completing),
            ("NODE_FAIL", Phase::Over),
            ("TIMEOUT", Phase::Over),
        ];
        for (state, phase) in expected {
            assert_eq!(Phase::of(state), phase, "{state}");
        }
    }
}
