-- The trajectories of walks, in the parts of the records of their assignments: `frames` frames each, whose numbers `data` has
-- (`src/trajectory.rs`). Empty unless `walk.trajectory_interval` is set.
CREATE TABLE trajectory (
    walk INTEGER NOT NULL,
    part INTEGER NOT NULL,
    frames INTEGER NOT NULL,
    data BLOB NOT NULL,
    checksum INTEGER NOT NULL,
    PRIMARY KEY (walk, part)
) STRICT;

PRAGMA user_version = 21;
