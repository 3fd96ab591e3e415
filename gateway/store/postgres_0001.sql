-- Knowledge in PostgreSQL: as 0002_knowledge.sql says for SQLite; of the four columns of a value at most one is not null.
CREATE TABLE origin (
  id SERIAL PRIMARY KEY,
  name TEXT NOT NULL UNIQUE,
  own BOOLEAN NOT NULL,
  system TEXT NOT NULL,
  prototype BOOLEAN NOT NULL
);
CREATE TABLE event (
  origin INTEGER NOT NULL REFERENCES origin (id),
  sequence BIGINT NOT NULL,
  t_ms BIGINT NOT NULL,
  kind SMALLINT NOT NULL,
  name TEXT NOT NULL,
  whole BIGINT,
  real DOUBLE PRECISION,
  words TEXT,
  data BYTEA,
  quality SMALLINT NOT NULL,
  reason SMALLINT NOT NULL,
  PRIMARY KEY (origin, sequence)
);
CREATE TABLE lost (
  origin INTEGER NOT NULL REFERENCES origin (id),
  first BIGINT NOT NULL,
  last BIGINT NOT NULL,
  PRIMARY KEY (origin, first)
);
