//! The steps that bring a database of an earlier version up to date.
//!
//! They stand in the program, and the library looks at what a database has already had of them. Its macro that finds
//! the files by itself would build both databases a second time, for the compiler.

use sqlx::SqlSafeStr;
use sqlx::migrate::{Migration, MigrationType, Migrator};

/// Version, name and text of a step, as its file `<version>_<name>.sql` has them.
pub type Step = (i64, &'static str, &'static str);

/// The steps in their order.
pub fn migrator(steps: &[Step]) -> Migrator {
    let migrations = steps.iter().map(|(version, name, text)| {
        Migration::new(*version, (*name).into(), MigrationType::Simple, text.into_sql_str(), false)
    });
    Migrator::with_migrations(migrations.collect())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// Every file is there, as the library itself reads the folder: same versions, names and checksums.
    #[tokio::test]
    async fn the_steps_are_the_files_of_their_folder() {
        for (folder, steps) in
            [("sqlite", &crate::sqlite::STEPS[..]), ("postgres", &crate::postgres::STEPS[..])]
        {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations").join(folder);
            let known = |migrator: Migrator| -> Vec<_> {
                migrator.iter().map(|m| (m.version, m.description.clone(), m.checksum.clone())).collect()
            };
            assert_eq!(known(migrator(steps)), known(Migrator::new(path).await.unwrap()), "{folder}");
        }
    }
}
