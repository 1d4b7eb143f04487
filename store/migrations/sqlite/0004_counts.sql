-- How many candidates there are of each origin, and of what became of them: 'accepted', or why they were declined. Kept with every
-- commit, since whoever looks at a campaign would count for seconds.
CREATE TABLE candidate_count (
    origin TEXT NOT NULL,
    fate TEXT NOT NULL,
    number INTEGER NOT NULL,
    PRIMARY KEY (origin, fate)
) STRICT, WITHOUT ROWID;
INSERT INTO candidate_count
    SELECT origin, coalesce(reason, fate), count(*) FROM candidate GROUP BY origin, fate, reason;

PRAGMA user_version = 4;
