-- How many candidates there are of each origin, and of what became of them: 'accepted', or why they were declined. Kept with every
-- commit, since whoever looks at a campaign would count for seconds.
CREATE TABLE candidate_count (
    origin TEXT COLLATE "C" NOT NULL,
    fate TEXT COLLATE "C" NOT NULL,
    number BIGINT NOT NULL,
    PRIMARY KEY (origin, fate)
);
INSERT INTO candidate_count
    SELECT origin, coalesce(reason, fate), count(*) FROM candidate GROUP BY origin, fate, reason;
