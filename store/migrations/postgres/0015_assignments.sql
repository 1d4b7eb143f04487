-- What migrations/sqlite/0015_assignments.sql renames.
ALTER TABLE walk RENAME COLUMN turn TO assignments;
