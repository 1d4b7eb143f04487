-- Columns and tables are called as what they hold is called everywhere else.
ALTER TABLE label RENAME COLUMN standing TO status;
ALTER TABLE walk RENAME COLUMN refused TO rejected;
ALTER TABLE walk RENAME COLUMN returns TO rollbacks;
ALTER TABLE pace RENAME TO walk_progress;
UPDATE campaign SET key = 'throughput' WHERE key = 'pace';
UPDATE campaign SET value = replace(value, '"most_structures":', '"max_structures":') WHERE key = 'note/forecast';

-- Ends of walks, reasons to decline and failure classes have the words that views show. The program renames those in rows
-- with checksums, in the same transaction (`src/tables/renamed_words.rs`).
UPDATE candidate_count SET fate = 'too_close' WHERE fate = 'guard';
UPDATE attempt SET class = 'node_failure' WHERE class = 'lost_node';
UPDATE attempt SET class = 'rejected_by_label_guard' WHERE class = 'refused';
UPDATE campaign SET value = replace(value, '"lost_node"', '"node_failure"') WHERE key LIKE 'note/reference_check/%';

PRAGMA user_version = 16;
