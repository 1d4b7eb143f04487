-- What migrations/sqlite/0014_start_time.sql renames, and the same of the leader.
ALTER TABLE process RENAME COLUMN birth TO start_time;
ALTER TABLE leader RENAME COLUMN birth TO start_time;
