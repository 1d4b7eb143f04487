-- The table of candidates is looked at in these orders too, a page at a time.
CREATE INDEX candidate_gamma ON candidate (original_gamma, decision);
CREATE INDEX candidate_volume ON candidate (relative_volume, decision);

PRAGMA user_version = 7;
