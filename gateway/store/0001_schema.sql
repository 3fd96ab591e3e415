-- A run of a controller; `prototype` says that its field side was emulated (SPEC ruling 15).
CREATE TABLE run (
  id INTEGER PRIMARY KEY,
  started_utc TEXT NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now')),
  system TEXT NOT NULL,
  prototype INTEGER NOT NULL
);
-- The control logic's dataLog: ordered, time-stamped, duplicates kept (SPEC ruling 2).
CREATE TABLE exchange (
  id INTEGER PRIMARY KEY,
  run INTEGER NOT NULL REFERENCES run (id),
  tag TEXT NOT NULL,
  sequence INTEGER NOT NULL,
  t_ns INTEGER NOT NULL,
  payload BLOB NOT NULL
);
CREATE INDEX exchange_by_run ON exchange (run, tag, sequence);
