-- What migrations/sqlite/0010_exclude.sql adds.
ALTER TABLE label
    ADD COLUMN excluded BIGINT,
    ADD COLUMN exclusion TEXT,
    DROP CONSTRAINT label_standing_check,
    ADD CONSTRAINT label_standing_check CHECK (standing IN ('label', 'check', 'superseded', 'excluded'));

CREATE INDEX label_excluded ON label (structure, protocol) WHERE standing = 'excluded';
