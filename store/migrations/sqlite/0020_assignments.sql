-- Each assignment of a walk, or each part of one that was interrupted, so that the walk can be run again: what its walker began with, and
-- where it ended. Walks that began under earlier versions have none. `reference_step` is NULL after the reference run of a walk at
-- constant pressure, and in others.
CREATE TABLE assignment (
    walk INTEGER NOT NULL,
    part INTEGER NOT NULL,
    number INTEGER NOT NULL,
    mixture_version INTEGER NOT NULL,
    threshold_factor REAL NOT NULL,
    verdict TEXT,
    start_segment INTEGER NOT NULL,
    start_step INTEGER NOT NULL,
    start_reference_step INTEGER,
    segment INTEGER NOT NULL,
    step INTEGER NOT NULL,
    reference_step INTEGER,
    checksum INTEGER NOT NULL,
    PRIMARY KEY (walk, part)
) STRICT, WITHOUT ROWID;

-- V0 of each walk at constant pressure from its first step on: Å³, Å² for a slab, Å for a wire.
CREATE TABLE reference_volume (
    walk INTEGER PRIMARY KEY,
    volume REAL NOT NULL,
    checksum INTEGER NOT NULL
) STRICT;

ALTER TABLE walk_progress ADD COLUMN reference_step INTEGER;

PRAGMA user_version = 20;
