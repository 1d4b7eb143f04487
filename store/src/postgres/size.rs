//! The size of a campaign on a server.

use super::server::PostgresServer;
use crate::database::{Database, query};
use crate::error::Result;

impl PostgresServer {
    /// Size of the tables in bytes, with their indexes and long columns.
    pub async fn size(&self) -> Result<u64> {
        let sql =
            "SELECT CAST(coalesce(sum(pg_total_relation_size(pg_class.oid)), 0) AS BIGINT) FROM pg_class
                   JOIN pg_namespace ON pg_namespace.oid = relnamespace
                   WHERE nspname = current_schema() AND relkind = 'r'";
        query(sql).fetch_one(&Database::Postgres(self.clone())).await
    }
}
