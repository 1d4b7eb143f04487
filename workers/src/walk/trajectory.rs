//! The frames of a walk's trajectory ([`wire::WalkFrame`]).

use wire::WalkFrame;

use super::RunningWalk;

impl RunningWalk<'_> {
    /// Adds a frame if one is due at this step, which is the start of the walk or was just made.
    pub(super) fn add_frame_if_due(&mut self) {
        let step = self.step();
        if step.checked_rem(self.settings.trajectory_interval) != Some(0) {
            return;
        }
        let structure = self.dynamics.structure();
        self.frames.push(WalkFrame {
            segment: self.state.segment,
            step,
            time: step as f64 * self.dynamics.checkpoint().time_step,
            temperature: self.dynamics.temperature(),
            cell: structure.cell.0,
            positions: WalkFrame::rounded(&structure.positions),
        });
    }

    /// Whether no frame more fits into the report. Roll backs make long assignments.
    pub(super) fn frames_are_full(&self) -> bool {
        self.frames.len() >= self.settings.max_frames
    }
}
