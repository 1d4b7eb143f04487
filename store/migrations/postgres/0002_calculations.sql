-- What migrations/sqlite/0003_calculations.sql adds, with the types of PostgreSQL.
ALTER TABLE attempt
    ADD COLUMN cores BIGINT,
    ADD COLUMN core_seconds DOUBLE PRECISION,
    ADD COLUMN remedies TEXT,
    ADD COLUMN difference TEXT,
    ADD COLUMN atoms BIGINT,
    ADD COLUMN electrons DOUBLE PRECISION,
    ADD COLUMN k_points BIGINT;
CREATE INDEX attempt_under_way ON attempt (job) WHERE outcome IS NULL;

ALTER TABLE label ADD COLUMN details TEXT;

ALTER TABLE job ADD COLUMN overruled BIGINT;

CREATE TABLE archive (
    job BIGINT NOT NULL,
    attempt BIGINT NOT NULL,
    bytes BYTEA NOT NULL,
    left_out TEXT NOT NULL,
    PRIMARY KEY (job, attempt),
    FOREIGN KEY (job, attempt) REFERENCES attempt
);
ALTER TABLE archive ALTER COLUMN bytes SET STORAGE EXTERNAL;

INSERT INTO campaign SELECT 'labels_made',
    CAST(coalesce(sum(CASE WHEN outcome IN ('labelled', 'check') THEN 1 ELSE 0 END), 0) AS TEXT) FROM attempt;
INSERT INTO campaign SELECT 'core_milliseconds',
    CAST(coalesce(sum(CASE WHEN ended > started THEN ended - started ELSE 0 END), 0) AS TEXT) FROM attempt;

CREATE FUNCTION core_milliseconds(made attempt) RETURNS BIGINT LANGUAGE SQL IMMUTABLE
    RETURN CASE WHEN made.outcome IS NULL THEN 0 ELSE coalesce(CAST(round(1000 * made.core_seconds) AS BIGINT),
        CASE WHEN made.ended > made.started THEN (made.ended - made.started) * coalesce(made.cores, 1) ELSE 0 END) END;

CREATE FUNCTION write_down_what_was_spent() RETURNS TRIGGER LANGUAGE plpgsql AS $$
BEGIN
    UPDATE campaign SET value = CAST(CAST(value AS BIGINT)
        + CASE WHEN NEW.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END
        - CASE WHEN OLD.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END AS TEXT)
    WHERE key = 'labels_made';
    UPDATE campaign SET value = CAST(CAST(value AS BIGINT) + core_milliseconds(NEW) - core_milliseconds(OLD) AS TEXT)
    WHERE key = 'core_milliseconds';
    RETURN NULL;
END $$;
-- At the end of a transaction: these rows are everybody's, and are locked last and for as short as possible.
CREATE CONSTRAINT TRIGGER spent AFTER UPDATE OF ended, outcome, cores, core_seconds ON attempt
    DEFERRABLE INITIALLY DEFERRED
    FOR EACH ROW WHEN (NEW.outcome IS NOT NULL) EXECUTE FUNCTION write_down_what_was_spent();
