-- Knowledge: who writes, and what they wrote. `prototype` says that the field side was emulated (SPEC ruling 15).
CREATE TABLE origin (
  id INTEGER PRIMARY KEY,
  name TEXT NOT NULL UNIQUE,
  own INTEGER NOT NULL,
  system TEXT NOT NULL,
  prototype INTEGER NOT NULL
);
CREATE TABLE event_name (
  id INTEGER PRIMARY KEY,
  text TEXT NOT NULL UNIQUE
);
-- Numbered per origin, without holes in its writer's store. t_ms is UTC; kind, quality and reason as fieldtwin.gateway.store.event says.
CREATE TABLE event (
  origin INTEGER NOT NULL REFERENCES origin (id),
  sequence INTEGER NOT NULL,
  t_ms INTEGER NOT NULL,
  kind INTEGER NOT NULL,
  name INTEGER NOT NULL REFERENCES event_name (id),
  value,
  quality INTEGER NOT NULL,
  reason INTEGER NOT NULL,
  PRIMARY KEY (origin, sequence)
) WITHOUT ROWID;
-- What its writer has no more, or what was forgotten here: no gap.
CREATE TABLE lost (
  origin INTEGER NOT NULL REFERENCES origin (id),
  first INTEGER NOT NULL,
  last INTEGER NOT NULL,
  PRIMARY KEY (origin, first)
) WITHOUT ROWID;
