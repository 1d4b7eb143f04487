-- What migrations/sqlite/0005_jobs.sql adds, with the types of PostgreSQL.
CREATE TABLE job_count (
    protocol BIGINT NOT NULL,
    state TEXT COLLATE "C" NOT NULL,
    seed_structure BIGINT NOT NULL,
    formula TEXT COLLATE "C" NOT NULL,
    atoms BIGINT NOT NULL,
    number BIGINT NOT NULL,
    PRIMARY KEY (protocol, state, seed_structure, formula, atoms)
);
-- No job moves while they are counted.
LOCK TABLE job IN SHARE ROW EXCLUSIVE MODE;
INSERT INTO job_count SELECT protocol, state, seed_structure, formula, atoms, count(*)
    FROM job JOIN candidate ON candidate.decision = job.decision GROUP BY 1, 2, 3, 4, 5;

-- Counts are everybody's. Who changes some has this lock first and keeps it to the end of the transaction, so that nobody waits for
-- somebody who waits for him.
CREATE FUNCTION lock_counts() RETURNS VOID LANGUAGE SQL VOLATILE
    RETURN pg_advisory_xact_lock(hashtextextended('calmwalk counts ' || current_schema(), 0));

CREATE FUNCTION count_job(counted job, change BIGINT) RETURNS VOID LANGUAGE SQL VOLATILE AS $$
    INSERT INTO job_count SELECT counted.protocol, counted.state, seed_structure, formula, atoms, change
        FROM candidate WHERE decision = counted.decision
        ON CONFLICT (protocol, state, seed_structure, formula, atoms) DO UPDATE SET number = job_count.number + change
$$;
CREATE FUNCTION count_jobs() RETURNS TRIGGER LANGUAGE plpgsql AS $$
BEGIN
    PERFORM lock_counts();
    IF TG_OP = 'UPDATE' THEN
        PERFORM count_job(OLD, -1);
    END IF;
    PERFORM count_job(NEW, 1);
    RETURN NULL;
END $$;
-- At the end of a transaction, as what was spent.
CREATE CONSTRAINT TRIGGER job_came AFTER INSERT ON job DEFERRABLE INITIALLY DEFERRED
    FOR EACH ROW EXECUTE FUNCTION count_jobs();
CREATE CONSTRAINT TRIGGER job_moved AFTER UPDATE OF state ON job DEFERRABLE INITIALLY DEFERRED
    FOR EACH ROW WHEN (NEW.state <> OLD.state) EXECUTE FUNCTION count_jobs();

CREATE OR REPLACE FUNCTION write_down_what_was_spent() RETURNS TRIGGER LANGUAGE plpgsql AS $$
BEGIN
    PERFORM lock_counts();
    UPDATE campaign SET value = CAST(CAST(value AS BIGINT)
        + CASE WHEN NEW.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END
        - CASE WHEN OLD.outcome IN ('labelled', 'check') THEN 1 ELSE 0 END AS TEXT)
    WHERE key = 'labels_made';
    UPDATE campaign SET value = CAST(CAST(value AS BIGINT) + core_milliseconds(NEW) - core_milliseconds(OLD) AS TEXT)
    WHERE key = 'core_milliseconds';
    RETURN NULL;
END $$;

CREATE INDEX attempt_failed ON attempt (class, job) WHERE class IS NOT NULL;
CREATE INDEX label_made ON label (received) WHERE job IS NOT NULL;

CREATE TABLE pace (
    walk BIGINT PRIMARY KEY,
    seen BIGINT NOT NULL,
    segment BIGINT NOT NULL,
    step BIGINT NOT NULL,
    steps_per_second DOUBLE PRECISION,
    tau DOUBLE PRECISION,
    temperature DOUBLE PRECISION,
    relative_volume DOUBLE PRECISION,
    gamma_max DOUBLE PRECISION
);
