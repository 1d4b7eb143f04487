-- The state of the campaign over time, for those who watch; decides nothing. `run` is when the run that wrote a sample began: between two runs,
-- nothing ran. Times are ms since 1970. Samples are thinned out as they age.
CREATE TABLE sample (
    time INTEGER PRIMARY KEY,
    run INTEGER NOT NULL,
    seen INTEGER NOT NULL,
    accepted INTEGER NOT NULL,
    queued INTEGER NOT NULL,
    leased INTEGER NOT NULL,
    labels INTEGER NOT NULL,
    failed_attempts INTEGER NOT NULL,
    failed_jobs INTEGER NOT NULL,
    core_milliseconds INTEGER NOT NULL,
    mixture_version INTEGER NOT NULL,
    steps_per_second REAL,
    walkers_busy REAL
) STRICT;

PRAGMA user_version = 22;
