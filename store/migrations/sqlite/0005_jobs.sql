-- How many label jobs there are of each protocol, state and size. Kept with every change: whoever looks at a campaign, and at what its
-- labels will cost, would count for seconds.
CREATE TABLE job_count (
    protocol INTEGER NOT NULL,
    state TEXT NOT NULL,
    seed_structure INTEGER NOT NULL,
    formula TEXT NOT NULL,
    atoms INTEGER NOT NULL,
    number INTEGER NOT NULL,
    PRIMARY KEY (protocol, state, seed_structure, formula, atoms)
) STRICT, WITHOUT ROWID;
INSERT INTO job_count SELECT protocol, state, seed_structure, formula, atoms, count(*)
    FROM job JOIN candidate ON candidate.decision = job.decision GROUP BY 1, 2, 3, 4, 5;

CREATE TRIGGER job_came AFTER INSERT ON job
BEGIN
    INSERT INTO job_count SELECT NEW.protocol, NEW.state, seed_structure, formula, atoms, 1
        FROM candidate WHERE decision = NEW.decision ON CONFLICT DO UPDATE SET number = number + 1;
END;
CREATE TRIGGER job_moved AFTER UPDATE OF state ON job WHEN NEW.state <> OLD.state
BEGIN
    INSERT INTO job_count SELECT OLD.protocol, OLD.state, seed_structure, formula, atoms, -1
        FROM candidate WHERE decision = OLD.decision ON CONFLICT DO UPDATE SET number = number - 1;
    INSERT INTO job_count SELECT NEW.protocol, NEW.state, seed_structure, formula, atoms, 1
        FROM candidate WHERE decision = NEW.decision ON CONFLICT DO UPDATE SET number = number + 1;
END;

-- The few attempts that failed, and the labels of the last hour.
CREATE INDEX attempt_failed ON attempt (class, job) WHERE class IS NOT NULL;
CREATE INDEX label_made ON label (received) WHERE job IS NOT NULL;

-- How fast a walk advances, and where it stands between its checkpoints, for those who watch; decides nothing. `seen`: when its walker was
-- last heard, ms since 1970.
CREATE TABLE pace (
    walk INTEGER PRIMARY KEY,
    seen INTEGER NOT NULL,
    segment INTEGER NOT NULL,
    step INTEGER NOT NULL,
    steps_per_second REAL,
    tau REAL,
    temperature REAL,
    relative_volume REAL,
    gamma_max REAL
) STRICT;

PRAGMA user_version = 5;
