//! Why a refit ends without a new version.

use potentials::grace::GraceError;
use store::StoreError;
use upfit::UpfitError;

use crate::exit_status::CommandError;

/// Why a refit ends without a new version.
#[derive(Debug)]
pub enum RefitFailure {
    /// The new version is refused for this reason, and the campaign continues with the one that it has.
    Refused(String),
    /// The refit cannot continue: a disk, the database, a file of the configuration. The same refit continues later.
    Failed(CommandError),
}

impl RefitFailure {
    /// A refusal for this reason.
    pub fn refused(reason: impl ToString) -> Self {
        Self::Refused(reason.to_string())
    }

    /// An error of data and models that are checked already: where they are wrong, there can be no version.
    pub fn of_input(error: CommandError) -> Self {
        match error {
            CommandError::Input(reason) => Self::Refused(reason),
            failed @ (CommandError::Unreadable(_) | CommandError::Failed(_)) => Self::Failed(failed),
        }
    }

    /// An error of a model file. One that the system cannot read says nothing about the model.
    pub fn of_model(error: GraceError) -> Self {
        match error {
            GraceError::Read { .. } => Self::Failed(CommandError::failed(error)),
            wrong => Self::refused(wrong),
        }
    }

    /// An error of a training or of the evaluation of a new model. Labels and losses that give no model are a reason to refuse it.
    pub fn of_training(error: UpfitError) -> Self {
        let of_checkpoint = matches!(error, UpfitError::OtherTraining { .. });
        if matches!(error, UpfitError::NotFinite { .. }) || (error.is_wrong_input() && !of_checkpoint) {
            Self::refused(error)
        } else {
            Self::Failed(CommandError::failed(error))
        }
    }
}

impl From<CommandError> for RefitFailure {
    fn from(error: CommandError) -> Self {
        Self::Failed(error)
    }
}

impl From<StoreError> for RefitFailure {
    fn from(error: StoreError) -> Self {
        Self::Failed(error.into())
    }
}

#[cfg(test)]
mod tests {
    use atoms::FileError;

    use super::*;

    #[test]
    fn only_what_a_version_is_made_of_is_a_reason_to_refuse_it() {
        let is_refused = |failure: &RefitFailure| matches!(failure, RefitFailure::Refused(_));
        let not_finite = UpfitError::NotFinite {
            epoch: 3,
            place: "validation".into(),
            what: "the loss",
            frames: "a:1".into(),
        };
        assert!(is_refused(&RefitFailure::of_training(not_finite)));
        assert!(is_refused(&RefitFailure::of_training(UpfitError::NoFrames)));
        let threads = UpfitError::Threads { threads: 4, reason: "none left".into() };
        assert!(!is_refused(&RefitFailure::of_training(threads)));
        let other = UpfitError::OtherTraining {
            path: "model.npz.upfit".into(),
            name: "random seed".into(),
            saved: "1".into(),
            now: "2".into(),
        };
        assert!(!is_refused(&RefitFailure::of_training(other)), "its directory can be removed");
        assert!(is_refused(&RefitFailure::of_input(CommandError::input("a label"))));
        assert!(!is_refused(&RefitFailure::of_input(CommandError::failed("a disk"))));
        assert!(!is_refused(&CommandError::input("a file of the configuration").into()));
        // As of a file system that is gone for a moment, or a process with too many open files.
        let system = || std::io::Error::from_raw_os_error(24);
        let open = FileError::Open { path: "train.extxyz".into(), source: system() };
        assert!(!is_refused(&RefitFailure::of_input(open.into())));
        assert!(is_refused(&RefitFailure::of_input(FileError::Empty("train.extxyz".into()).into())));
        let read = GraceError::Read { path: "model.npz".into(), source: system() };
        assert!(!is_refused(&RefitFailure::of_model(read)));
        let damaged = GraceError::Damaged { path: "model.npz".into(), key: None, reason: "text".into() };
        assert!(is_refused(&RefitFailure::of_model(damaged)));
    }
}
