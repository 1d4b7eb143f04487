-- What it takes to know a process again, and what happened to it. `birth` tells a process from a later one with the
-- same pid, `number` is that of a walker or labeller, `setup` the hash of what a labeller was started with.
ALTER TABLE process ADD COLUMN number INTEGER;
ALTER TABLE process ADD COLUMN birth TEXT NOT NULL DEFAULT '';
ALTER TABLE process ADD COLUMN setup TEXT;
ALTER TABLE process ADD COLUMN restarts INTEGER NOT NULL DEFAULT 0;
ALTER TABLE process ADD COLUMN remark TEXT NOT NULL DEFAULT '';

PRAGMA user_version = 2;
