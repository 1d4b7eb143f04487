-- What migrations/sqlite/0013_queued_imports.sql changes.
ALTER TABLE job DROP CONSTRAINT IF EXISTS job_decision_fkey;

CREATE OR REPLACE FUNCTION count_job(counted job, change BIGINT) RETURNS VOID LANGUAGE SQL VOLATILE AS $$
    INSERT INTO job_count SELECT counted.protocol, counted.state,
            coalesce((SELECT seed_structure FROM candidate WHERE decision = counted.decision), 4294967295), formula, atoms, change
        FROM structure WHERE structure.number = counted.structure
        ON CONFLICT (protocol, state, seed_structure, formula, atoms) DO UPDATE SET number = job_count.number + change
$$;
