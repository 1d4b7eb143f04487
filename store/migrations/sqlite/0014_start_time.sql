-- What tells a process from a later one with the same pid is called `start_time` as everywhere else.
ALTER TABLE process RENAME COLUMN birth TO start_time;

PRAGMA user_version = 14;
