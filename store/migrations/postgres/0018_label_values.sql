-- What migrations/sqlite/0018_label_values.sql adds.
ALTER TABLE job ADD COLUMN value DOUBLE PRECISION;
ALTER TABLE job ADD COLUMN value_factors TEXT;
DROP INDEX job_order;
CREATE INDEX job_order ON job (state, priority DESC, value DESC NULLS LAST, decision, protocol);
