-- What migrations/sqlite/0022_samples.sql adds.
CREATE TABLE sample (
    time BIGINT PRIMARY KEY,
    run BIGINT NOT NULL,
    seen BIGINT NOT NULL,
    accepted BIGINT NOT NULL,
    queued BIGINT NOT NULL,
    leased BIGINT NOT NULL,
    labels BIGINT NOT NULL,
    failed_attempts BIGINT NOT NULL,
    failed_jobs BIGINT NOT NULL,
    core_milliseconds BIGINT NOT NULL,
    mixture_version BIGINT NOT NULL,
    steps_per_second DOUBLE PRECISION,
    walkers_busy DOUBLE PRECISION
);
