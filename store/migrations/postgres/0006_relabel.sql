-- What migrations/sqlite/0006_relabel.sql adds, with the types of PostgreSQL.
ALTER TABLE job
    ADD COLUMN relabel TEXT,
    ADD COLUMN relabel_after BIGINT,
    DROP CONSTRAINT job_state_check,
    ADD CONSTRAINT job_state_check
        CHECK (state IN ('queued', 'leased', 'labelled', 'failed', 'dropped', 'superseded'));

ALTER TABLE label
    ADD COLUMN superseded BIGINT,
    ADD COLUMN reason TEXT;

CREATE INDEX job_relabel ON job (state) WHERE relabel IS NOT NULL;
