-- The trace of each walk: temperature, pressure, cell, grade and bias at an interval of steps. `data` has the numbers of `points` points by
-- quantity (`src/walk_trace.rs`), at most 513 of them. Walks of earlier versions have none.
CREATE TABLE walk_trace (
    walk INTEGER PRIMARY KEY,
    points INTEGER NOT NULL,
    data BLOB NOT NULL,
    checksum INTEGER NOT NULL
) STRICT;

PRAGMA user_version = 19;
