-- The number of assignments of a walk that were reported is called so.
ALTER TABLE walk RENAME COLUMN turn TO assignments;

PRAGMA user_version = 15;
