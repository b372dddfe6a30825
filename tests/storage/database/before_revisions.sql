-- The tables of SQLite as envmatte made them before its database had revisions.

CREATE TABLE captures (
    number INTEGER NOT NULL,
    id VARCHAR(32) NOT NULL,
    name TEXT NOT NULL,
    state VARCHAR(16) NOT NULL,
    job VARCHAR(32) NOT NULL,
    bytes BIGINT NOT NULL,
    width INTEGER,
    height INTEGER,
    frames INTEGER NOT NULL,
    program JSON NOT NULL,
    problem JSON,
    created_at FLOAT NOT NULL,
    PRIMARY KEY (number),
    UNIQUE (id)
);
CREATE TABLE mattes (
    number INTEGER NOT NULL,
    id VARCHAR(32) NOT NULL,
    capture VARCHAR(32) NOT NULL,
    job VARCHAR(32) NOT NULL,
    state VARCHAR(16) NOT NULL,
    options JSON NOT NULL,
    figures JSON,
    created_at FLOAT NOT NULL,
    PRIMARY KEY (number),
    UNIQUE (id)
);
CREATE TABLE programs (
    number INTEGER NOT NULL,
    id VARCHAR(32) NOT NULL,
    program JSON NOT NULL,
    created_at FLOAT NOT NULL,
    PRIMARY KEY (number),
    UNIQUE (id)
);
CREATE TABLE jobs (
    number INTEGER NOT NULL,
    id VARCHAR(32) NOT NULL,
    kind VARCHAR(16) NOT NULL,
    state VARCHAR(16) NOT NULL,
    stage VARCHAR(16) NOT NULL,
    capture VARCHAR(32) NOT NULL,
    matte VARCHAR(32),
    options JSON NOT NULL,
    "plan" JSON,
    total INTEGER NOT NULL,
    done INTEGER NOT NULL,
    failed INTEGER NOT NULL,
    pixels BIGINT NOT NULL,
    problem JSON,
    created_at FLOAT NOT NULL,
    started_at FLOAT,
    finished_at FLOAT,
    PRIMARY KEY (number),
    UNIQUE (id)
);
CREATE INDEX ix_jobs_state ON jobs (state);
CREATE TABLE coordinator (
    id INTEGER NOT NULL,
    beat_at FLOAT NOT NULL,
    workers INTEGER NOT NULL,
    threads INTEGER NOT NULL,
    PRIMARY KEY (id)
);
CREATE TABLE uploads (
    id VARCHAR(32) NOT NULL,
    "key" VARCHAR(256),
    "offset" BIGINT NOT NULL,
    length BIGINT NOT NULL,
    parts INTEGER NOT NULL,
    metadata TEXT NOT NULL,
    created_at FLOAT NOT NULL,
    expires_at FLOAT NOT NULL,
    PRIMARY KEY (id),
    UNIQUE ("key")
);
CREATE INDEX ix_uploads_expires_at ON uploads (expires_at);
CREATE TABLE made (
    "key" VARCHAR(256) NOT NULL,
    call VARCHAR(64) NOT NULL,
    id VARCHAR(32) NOT NULL,
    PRIMARY KEY ("key", call)
);
CREATE TABLE tiles (
    job VARCHAR(32) NOT NULL,
    tile INTEGER NOT NULL,
    state VARCHAR(16) NOT NULL,
    attempts INTEGER NOT NULL,
    seconds FLOAT,
    PRIMARY KEY (job, tile),
    FOREIGN KEY(job) REFERENCES jobs (id) ON DELETE CASCADE
);
CREATE INDEX tiles_by_state ON tiles (job, state);
CREATE TABLE log (
    line INTEGER NOT NULL,
    job VARCHAR(32) NOT NULL,
    at FLOAT NOT NULL,
    text TEXT NOT NULL,
    PRIMARY KEY (line),
    FOREIGN KEY(job) REFERENCES jobs (id) ON DELETE CASCADE
);
CREATE INDEX ix_log_job ON log (job);
CREATE TABLE upload_parts (
    upload VARCHAR(32) NOT NULL,
    "offset" BIGINT NOT NULL,
    name VARCHAR(32) NOT NULL,
    size BIGINT NOT NULL,
    PRIMARY KEY (upload, "offset"),
    FOREIGN KEY(upload) REFERENCES uploads (id) ON DELETE CASCADE
);
