-- What migrations/sqlite/0016_words.sql renames.
ALTER TABLE label RENAME COLUMN standing TO status;
ALTER TABLE label RENAME CONSTRAINT label_standing_check TO label_status_check;
ALTER TABLE walk RENAME COLUMN refused TO rejected;
ALTER TABLE walk RENAME COLUMN returns TO rollbacks;
ALTER TABLE pace RENAME TO walk_progress;
UPDATE campaign SET key = 'throughput' WHERE key = 'pace';
UPDATE campaign SET value = replace(value, '"most_structures":', '"max_structures":') WHERE key = 'note/forecast';

UPDATE candidate_count SET fate = 'too_close' WHERE fate = 'guard';
UPDATE attempt SET class = 'node_failure' WHERE class = 'lost_node';
UPDATE attempt SET class = 'rejected_by_label_guard' WHERE class = 'refused';
UPDATE campaign SET value = replace(value, '"lost_node"', '"node_failure"') WHERE key LIKE 'note/reference_check/%';
