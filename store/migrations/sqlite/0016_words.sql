-- Columns and tables are called as what they hold is called everywhere else.
ALTER TABLE label RENAME COLUMN standing TO status;
ALTER TABLE walk RENAME COLUMN refused TO rejected;
ALTER TABLE walk RENAME COLUMN returns TO rollbacks;
ALTER TABLE pace RENAME TO walk_progress;
UPDATE campaign SET key = 'throughput' WHERE key = 'pace';
UPDATE campaign SET value = replace(value, '"most_structures":', '"max_structures":') WHERE key = 'note/forecast';

PRAGMA user_version = 16;
