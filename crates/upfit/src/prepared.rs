//! Frames with their neighbour lists.

use std::borrow::Cow;

use atoms::NeighbourList;
use potentials::grace::GraceModel;

use crate::data::LabelledFrame;
use crate::error::UpfitError;
use crate::frame_fault::FrameFault;
use crate::stop_request::StopRequest;

/// Memory for neighbour lists that are built once, bytes. The others are built at each use.
pub const NEIGHBOUR_BYTES: usize = 4 << 30;
/// Of one neighbour in a list, bytes.
const BYTES_PER_NEIGHBOUR: usize = 24;

/// A frame that the model can evaluate.
pub struct PreparedFrame<'a> {
    /// The frame.
    pub frame: &'a LabelledFrame,
    cutoff: f64,
    /// `None` if it is built at each use.
    neighbours: Option<NeighbourList>,
}

/// Builds the neighbour lists of all frames, and keeps them while they fit `room` (bytes), which is reduced. Returns `None` if `stop`
/// asked for it.
///
/// # Errors
/// A frame with an element that the model lacks, or whose neighbour list cannot be built.
pub fn prepare<'a>(
    model: &GraceModel,
    frames: &'a [LabelledFrame],
    room: &mut usize,
    stop: StopRequest<'_>,
) -> Result<Option<Vec<PreparedFrame<'a>>>, UpfitError> {
    let mut prepared = Vec::with_capacity(frames.len());
    for frame in frames {
        if stop() {
            return Ok(None);
        }
        model.element_indices(&frame.structure.species).map_err(|error| frame.wrong(error.into()))?;
        let mut made = PreparedFrame { frame, cutoff: model.cutoff(), neighbours: None };
        let list = made.build().map_err(|fault| frame.wrong(fault))?;
        let neighbours: usize = (0..list.len()).map(|atom| list.neighbours_of(atom).len()).sum();
        if let Some(left) = room.checked_sub(BYTES_PER_NEIGHBOUR * neighbours) {
            *room = left;
            made.neighbours = Some(list);
        }
        prepared.push(made);
    }
    Ok(Some(prepared))
}

impl PreparedFrame<'_> {
    /// The neighbour list.
    ///
    /// # Errors
    /// None that [`prepare`] has not found.
    pub fn neighbours(&self) -> Result<Cow<'_, NeighbourList>, FrameFault> {
        match &self.neighbours {
            Some(list) => Ok(Cow::Borrowed(list)),
            None => self.build().map(Cow::Owned),
        }
    }

    fn build(&self) -> Result<NeighbourList, FrameFault> {
        let mut list = NeighbourList::new(self.cutoff, 0.0);
        list.update(&self.frame.structure)?;
        Ok(list)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_frames::{aluminium, model};

    #[test]
    fn lists_are_kept_while_they_fit() {
        let (model, frames) = (model(), aluminium(3));
        let mut room = usize::MAX;
        let kept = prepare(model.model(), &frames, &mut room, &|| false).unwrap().unwrap();
        let used = usize::MAX - room;
        assert!(used > 0 && kept.iter().all(|frame| matches!(frame.neighbours(), Ok(Cow::Borrowed(_)))));
        let mut little = used / 2;
        let some = prepare(model.model(), &frames, &mut little, &|| false).unwrap().unwrap();
        let owned = some.iter().filter(|frame| matches!(frame.neighbours(), Ok(Cow::Owned(_)))).count();
        assert!((1..3).contains(&owned), "{owned}");
        for (a, b) in kept.iter().zip(&some) {
            let (a, b) = (a.neighbours().unwrap(), b.neighbours().unwrap());
            assert!((0..a.len()).all(|atom| a.neighbours_of(atom) == b.neighbours_of(atom)));
        }
    }

    #[test]
    fn an_element_that_the_model_lacks_is_named() {
        let mut frames = aluminium(2);
        frames[1].structure.species[4] = atoms::Species::from_atomic_number(14).unwrap();
        let Err(error) = prepare(model().model(), &frames, &mut 0, &|| false) else { panic!("silicon") };
        let message = error.to_string();
        assert!(message.contains(&frames[1].place) && message.contains("atom 4 is Si"), "{message}");
    }
}
