-- What a calculation was: cores, core-seconds (of all its time, known when it ended; none if the attempt only took its own
-- time), what was changed before it (names separated by commas) and so in its input, and what its cost depends on. A
-- calculation that a later attempt takes over is counted there.
ALTER TABLE attempt ADD COLUMN cores INTEGER;
ALTER TABLE attempt ADD COLUMN core_seconds REAL;
ALTER TABLE attempt ADD COLUMN remedies TEXT;
ALTER TABLE attempt ADD COLUMN difference TEXT;
ALTER TABLE attempt ADD COLUMN atoms INTEGER;
ALTER TABLE attempt ADD COLUMN electrons REAL;
ALTER TABLE attempt ADD COLUMN k_points INTEGER;
CREATE INDEX attempt_under_way ON attempt (job) WHERE outcome IS NULL;

-- What is known of a label besides its numbers, a JSON object; none if nothing is.
ALTER TABLE label ADD COLUMN details TEXT;

-- 1: somebody put the job back into the queue by hand, and guards let it pass.
ALTER TABLE job ADD COLUMN overruled INTEGER;

-- The directory of a calculation, packed (tar, zstd); `left_out` names the files that were too large.
CREATE TABLE archive (
    job INTEGER NOT NULL,
    attempt INTEGER NOT NULL,
    bytes BLOB NOT NULL,
    left_out TEXT NOT NULL,
    PRIMARY KEY (job, attempt),
    FOREIGN KEY (job, attempt) REFERENCES attempt
) STRICT;

-- What all attempts that ended have used up is kept as a sum: budgets are looked at before every lease.
INSERT INTO campaign SELECT 'labels_made',
    CAST(coalesce(sum(CASE WHEN outcome IN ('labelled', 'check') THEN 1 ELSE 0 END), 0) AS TEXT) FROM attempt;
INSERT INTO campaign SELECT 'core_milliseconds',
    CAST(coalesce(sum(CASE WHEN ended > started THEN ended - started ELSE 0 END), 0) AS TEXT) FROM attempt;

CREATE TRIGGER spent AFTER UPDATE OF ended, outcome, cores, core_seconds ON attempt WHEN NEW.outcome IS NOT NULL
BEGIN
    UPDATE campaign SET value = CAST(CAST(value AS INTEGER)
        + CASE WHEN NEW.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END
        - CASE WHEN OLD.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END AS TEXT)
    WHERE key = 'labels_made';
    UPDATE campaign SET value = CAST(CAST(value AS INTEGER)
        + coalesce(CAST(round(1000 * NEW.core_seconds) AS INTEGER),
            CASE WHEN NEW.ended > NEW.started THEN (NEW.ended - NEW.started) * coalesce(NEW.cores, 1) ELSE 0 END)
        - CASE WHEN OLD.outcome IS NULL THEN 0 ELSE coalesce(CAST(round(1000 * OLD.core_seconds) AS INTEGER),
            CASE WHEN OLD.ended > OLD.started THEN (OLD.ended - OLD.started) * coalesce(OLD.cores, 1) ELSE 0 END) END
        AS TEXT)
    WHERE key = 'core_milliseconds';
END;

PRAGMA user_version = 3;
