//! The picked structures with all that their frames had.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use atoms::extxyz::Frame;
use store::records::Fate;

use super::grading::{PoolFiles, hash};
use super::picks::Pick;
use super::{GradedPool, StructureSource};
use crate::exit_status::CommandError;

/// The frames of the picks, in order: what the files have, read again, and what the campaigns have, with `selection_strategy`,
/// `selection_rank` (from 1), `gamma_max`, and `source_file` and `source_frame` (from 0) or `campaign`, `candidate_id` and `fate`.
pub fn frames(files: &PoolFiles, pool: &GradedPool, picks: &[Pick]) -> Result<Vec<Frame>, CommandError> {
    let mut frames: Vec<Option<Frame>> = picks.iter().map(|_| None).collect();
    read_files(files, pool, picks, &mut frames)?;
    let mut found = Vec::with_capacity(picks.len());
    for (rank, (frame, pick)) in frames.into_iter().zip(picks).enumerate() {
        let structure = &pool.structures[pick.structure];
        let mut frame = match (frame, structure.source) {
            (Some(frame), _) => frame,
            (None, StructureSource::Candidate { campaign, decision }) => {
                candidate(files, campaign, decision)?
            }
            (None, StructureSource::File { file, .. }) => {
                let path = files.files.files[file as usize].path.display();
                return Err(CommandError::Failed(format!(
                    "{path}: the file became shorter during the selection"
                )));
            }
        };
        let mut info = |key: &str, value| frame.info.insert(key.to_owned(), value);
        info("selection_strategy", pick.strategy.into());
        info("selection_rank", (rank as i64 + 1).into());
        info("gamma_max", pick.gamma_max.into());
        found.push(frame);
    }
    Ok(found)
}

/// Reads the files up to the last picked structure.
fn read_files(
    files: &PoolFiles,
    pool: &GradedPool,
    picks: &[Pick],
    frames: &mut [Option<Frame>],
) -> Result<(), CommandError> {
    let of_file = |(rank, pick): (usize, &Pick)| match pool.structures[pick.structure].source {
        StructureSource::File { file, frame } => Some((file as usize, u64::from(frame), rank)),
        StructureSource::Candidate { .. } => None,
    };
    let mut wanted: Vec<_> = picks.iter().enumerate().filter_map(of_file).collect();
    wanted.sort_unstable();
    let mut reader = files.files.reader(Arc::new(AtomicU64::new(0)));
    for (in_file, in_frame, rank) in wanted {
        let (mut frame, file) = loop {
            let Some(found) = reader.next()? else { return Ok(()) };
            if (reader.file_index(), reader.frame_index()) >= (in_file, in_frame) {
                break found;
            }
        };
        let is_same = (reader.file_index(), reader.frame_index()) == (in_file, in_frame);
        if !is_same || hash(&frame.structure) != pool.structures[picks[rank].structure].hash {
            return Err(CommandError::Failed(format!(
                "{}:{}: the file was changed during the selection; repeat the command",
                file.path.display(),
                frame.line
            )));
        }
        frame.info.insert("source_file".to_owned(), file.path.display().to_string().into());
        frame.info.insert("source_frame".to_owned(), i64::try_from(in_frame).unwrap_or(i64::MAX).into());
        frames[rank] = Some(frame);
    }
    Ok(())
}

fn candidate(files: &PoolFiles, campaign: u32, decision: i64) -> Result<Frame, CommandError> {
    let campaign = &files.campaigns[campaign as usize];
    let found = campaign.candidate(decision)?;
    let view = found.block.view();
    let mut frame = Frame::from(view.structure());
    let fate = match found.fate {
        Fate::Accepted => "accepted",
        Fate::Declined(reason) => reason.name(),
    };
    let mut info = |key: &str, value| frame.info.insert(key.to_owned(), value);
    info("campaign", campaign.id.clone().into());
    info("candidate_id", view.id().to_string().into());
    info("fate", fate.into());
    for (key, value) in [("temperature", view.temperature()), ("relative_volume", view.relative_volume())] {
        if value.is_finite() {
            info(key, value.into());
        }
    }
    Ok(frame)
}
