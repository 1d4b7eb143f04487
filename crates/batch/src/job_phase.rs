//! The phase of a job.

/// The phase of a job from the submitter's point of view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobPhase {
    /// Waits in the queue.
    Pending,
    /// Has a node. Unknown states count as running, so that no duplicate is submitted.
    Running,
    /// Is ending; it may be requeued.
    Completing,
    /// Has ended and will not be requeued.
    Over,
}

impl JobPhase {
    /// The phase for a state in Slurm's notation, such as `RUNNING`.
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
    fn an_unknown_state_is_that_of_a_living_job() {
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
