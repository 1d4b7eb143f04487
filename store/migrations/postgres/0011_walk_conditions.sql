-- What migrations/sqlite/0011_walk_conditions.sql adds.
CREATE TABLE walk_conditions (
    walk BIGINT PRIMARY KEY,
    conditions TEXT NOT NULL,
    checksum BIGINT
);
