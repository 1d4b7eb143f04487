-- What migrations/sqlite/0020_assignments.sql adds.
CREATE TABLE assignment (
    walk BIGINT NOT NULL,
    part BIGINT NOT NULL,
    number BIGINT NOT NULL,
    mixture_version BIGINT NOT NULL,
    threshold_factor DOUBLE PRECISION NOT NULL,
    verdict TEXT,
    start_segment BIGINT NOT NULL,
    start_step BIGINT NOT NULL,
    start_reference_step BIGINT,
    segment BIGINT NOT NULL,
    step BIGINT NOT NULL,
    reference_step BIGINT,
    checksum BIGINT NOT NULL,
    PRIMARY KEY (walk, part)
);

CREATE TABLE reference_volume (
    walk BIGINT PRIMARY KEY,
    volume DOUBLE PRECISION NOT NULL,
    checksum BIGINT NOT NULL
);

ALTER TABLE walk_progress ADD COLUMN reference_step BIGINT;
