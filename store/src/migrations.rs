//! Migrations of databases of earlier versions.
//!
//! They are embedded in the program; sqlx records which ones a database has had. Its macro that embeds the files
//! would compile both databases a second time for the build.

use sqlx::SqlSafeStr;
use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};

use crate::error::StoreError;

/// Version, name and SQL of a migration, from its file `<version>_<name>.sql`.
pub type MigrationSource = (i64, &'static str, &'static str);

/// A migrator for these steps, in order.
pub fn migrator(steps: &[MigrationSource]) -> Migrator {
    let migrations = steps.iter().map(|(version, name, text)| {
        Migration::new(*version, (*name).into(), MigrationType::Simple, text.into_sql_str(), false)
    });
    Migrator::with_migrations(migrations.collect())
}

/// A failed migration; what the database says is told as it is elsewhere.
pub fn schema_error(error: MigrateError) -> StoreError {
    match error {
        MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _) => error.into(),
        error => StoreError::Schema(error),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// The steps match the files as sqlx reads the folder: same versions, names and checksums.
    #[tokio::test]
    async fn the_migrations_match_the_files_of_their_folder() {
        for (folder, steps) in
            [("sqlite", &crate::sqlite::open::STEPS[..]), ("postgres", &crate::postgres::open::STEPS[..])]
        {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations").join(folder);
            let known = |migrator: Migrator| -> Vec<_> {
                migrator.iter().map(|m| (m.version, m.description.clone(), m.checksum.clone())).collect()
            };
            assert_eq!(known(migrator(steps)), known(Migrator::new(path).await.unwrap()), "{folder}");
        }
    }
}
