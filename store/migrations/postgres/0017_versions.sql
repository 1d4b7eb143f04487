-- What migrations/sqlite/0017_versions.sql adds.
CREATE TABLE version (
    number BIGINT PRIMARY KEY,
    parent BIGINT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('registered', 'refused')),
    reason TEXT NOT NULL,
    method TEXT NOT NULL,
    structures BIGINT NOT NULL,
    last_decision BIGINT NOT NULL,
    labels BIGINT NOT NULL,
    model_hash TEXT NOT NULL,
    mixture_hash TEXT NOT NULL,
    figures TEXT NOT NULL,
    seconds DOUBLE PRECISION NOT NULL,
    core_hours DOUBLE PRECISION NOT NULL,
    time BIGINT NOT NULL,
    checksum BIGINT NOT NULL
);

CREATE TABLE version_file (
    version BIGINT NOT NULL REFERENCES version,
    name TEXT NOT NULL CHECK (name IN ('model', 'mixture')),
    data BYTEA NOT NULL,
    PRIMARY KEY (version, name)
);
ALTER TABLE version_file ALTER COLUMN data SET STORAGE EXTERNAL;
