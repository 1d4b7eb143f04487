//! Tables of an earlier version, which are looked at and stay as they are.

use std::sync::LazyLock;

use sqlx::ConnectOptions;
use sqlx::sqlite::SqliteConnectOptions;

use crate::error::Result;
use crate::tables::checksums;

/// Temporary views in the place of tables whose rows have no checksums: they say so, and are otherwise the same.
static VIEWS: LazyLock<String> = LazyLock::new(|| checksums::views("main"));

/// What each connection to such a database executes first; none for tables with checksums.
pub(super) async fn views(options: &SqliteConnectOptions) -> Result<Option<&'static str>> {
    let mut connection = options.connect().await?;
    let sql = "SELECT count(*) FROM pragma_table_info('label') WHERE name = 'checksum'";
    let found: i64 = sqlx::query_scalar(sql).fetch_one(&mut connection).await?;
    Ok((found == 0).then_some(VIEWS.as_str()))
}
