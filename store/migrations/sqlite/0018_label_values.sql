-- What the label of a queued structure is worth, and the factors of that value as JSON (`label.order`). Both are NULL in a queue in the
-- order in which structures were found. Among jobs of equal priority, the largest value comes first, and NULL last. A job that was leased
-- keeps the value that it was leased with.
ALTER TABLE job ADD COLUMN value REAL;
ALTER TABLE job ADD COLUMN value_factors TEXT;
DROP INDEX job_order;
CREATE INDEX job_order ON job (state, priority DESC, value DESC, decision, protocol);

PRAGMA user_version = 18;
