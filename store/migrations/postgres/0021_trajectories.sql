-- What migrations/sqlite/0021_trajectories.sql adds.
CREATE TABLE trajectory (
    walk BIGINT NOT NULL,
    part BIGINT NOT NULL,
    frames BIGINT NOT NULL,
    data BYTEA NOT NULL,
    checksum BIGINT NOT NULL,
    PRIMARY KEY (walk, part)
);
