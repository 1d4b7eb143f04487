-- What migrations/sqlite/0007_listing.sql adds.
CREATE INDEX candidate_gamma ON candidate (original_gamma, decision);
CREATE INDEX candidate_volume ON candidate (relative_volume, decision);
