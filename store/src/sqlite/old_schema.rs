//! Read-only access to tables of an earlier version.

use std::sync::LazyLock;

use sqlx::ConnectOptions;
use sqlx::sqlite::SqliteConnectOptions;

use crate::error::Result;
use crate::tables::checksums;

/// Temporary views that replace tables without checksums. They mark the checksums as unknown and are otherwise the
/// same.
static VIEWS: LazyLock<String> = LazyLock::new(|| checksums::views("main"));

/// SQL that each connection to such a database executes first; `None` for tables with checksums.
pub(super) async fn views(options: &SqliteConnectOptions) -> Result<Option<&'static str>> {
    let mut connection = options.connect().await?;
    let sql = "SELECT count(*) FROM pragma_table_info('label') WHERE name = 'checksum'";
    let found: i64 = sqlx::query_scalar(sql).fetch_one(&mut connection).await?;
    Ok((found == 0).then_some(VIEWS.as_str()))
}
