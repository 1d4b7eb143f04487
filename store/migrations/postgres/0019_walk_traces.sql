-- What migrations/sqlite/0019_walk_traces.sql adds.
CREATE TABLE walk_trace (
    walk BIGINT PRIMARY KEY,
    points BIGINT NOT NULL,
    data BYTEA NOT NULL,
    checksum BIGINT NOT NULL
);
