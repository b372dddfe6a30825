"""The tables of the database."""

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
    false,
    text,
)

from storage.database import owners

metadata = MetaData()


def _owner(*, primary_key: bool = False) -> Column[str]:
    return Column(
        "owner",
        String(64),
        nullable=False,
        primary_key=primary_key,
        default=owners.default_owner,
        server_default=owners.DEFAULT,
    )


captures = Table(
    "captures",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("name", Text, nullable=False),
    Column("state", String(16), nullable=False),
    Column("job", String(32), nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("width", Integer),
    Column("height", Integer),
    Column("frames", Integer, nullable=False),
    Column("program", JSON, nullable=False),
    Column("problem", JSON(none_as_null=True)),
    Column("created_at", Float, nullable=False),
    _owner(),
    Column("expires_at", Float, index=True),
    Column("stored", BigInteger),  # bytes in the store; null until counted
    Column(
        "row_bytes", BigInteger, nullable=False, server_default="0"
    ),  # of the program, see `rows.json_bytes`
    Index("captures_by_owner", "owner", "number"),
    Index("captures_by_state", "state", "bytes"),
    Index("captures_by_size", "stored", "state", "owner", "bytes", "row_bytes"),
)

mattes = Table(
    "mattes",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("capture", String(32)),  # capture and job are null for an imported matte
    Column("job", String(32)),
    Column("state", String(16), nullable=False),
    Column("options", JSON, nullable=False),
    Column("figures", JSON(none_as_null=True)),
    Column("created_at", Float, nullable=False),
    _owner(),
    Column("expires_at", Float, index=True),
    Column("stored", BigInteger),  # as for a capture
    Column("name", Text, nullable=False, server_default=text("''")),
    Index("mattes_by_owner", "owner", "number"),
    Index("mattes_by_capture", "capture", "owner", "number"),
    Index("mattes_by_state", "state"),
    Index("mattes_by_size", "stored", "state", "owner"),
)

programs = Table(
    "programs",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False),
    Column("program", JSON, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("showing", JSON(none_as_null=True)),  # playback progress, as the player last reported it
    _owner(),
    UniqueConstraint("owner", "id"),  # the id is a hash of the program, so two owners may share it
    Column("row_bytes", BigInteger, nullable=False, server_default="0"),  # of the program
    Index("programs_by_owner", "owner", "number"),
    Index("programs_by_size", "owner", "row_bytes"),
)

jobs = Table(
    "jobs",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("id", String(32), nullable=False, unique=True),
    Column("kind", String(16), nullable=False),
    Column("state", String(16), nullable=False),
    Column("stage", String(16), nullable=False),
    Column("capture", String(32), nullable=False),  # empty for a composite of an imported matte
    Column("matte", String(32)),
    Column("options", JSON, nullable=False),
    Column("plan", JSON(none_as_null=True)),
    Column("total", Integer, nullable=False, default=0),
    Column("done", Integer, nullable=False, default=0),
    Column("failed", Integer, nullable=False, default=0),
    Column("pixels", BigInteger, nullable=False, default=0),
    Column("problem", JSON(none_as_null=True)),
    Column("created_at", Float, nullable=False),
    Column("started_at", Float),
    Column("finished_at", Float),
    Column("stage_at", Float),  # when the current stage began
    Column("moved_at", Float),  # when a tile was last done
    Column("paced_at", Float),  # when measuring the pace began, and how many tiles were done then
    Column("paced_done", Integer, nullable=False, server_default="0"),
    Column("trace", String(64)),  # the request's traceparent (W3C)
    _owner(),
    Column("stored", BigInteger),  # bytes in the store, of a composite
    Index("jobs_by_owner", "owner", "number"),
    Column("webhook", Text),  # URL to notify when the job has ended
    Column("row_bytes", BigInteger, nullable=False, server_default="0"),  # of the plan and the log
    Column("leftovers", Boolean, nullable=False, server_default=false()),  # see `storage.records.jobs.end`
    Column("paused", Boolean, nullable=False, server_default=false()),
    Column("region", JSON(none_as_null=True)),  # x, y, width and height of what is recovered first
    Column("queued_at", Float),  # when it was last retried
    Index("jobs_by_state", "state", "leftovers"),
    Index("jobs_by_owner_and_state", "owner", "state", "number"),
    Index("jobs_by_kind", "kind", "state", "stored", "total", "done", "failed"),
    Index("jobs_by_size", "owner", "stored", "row_bytes", "total"),
)
"""Its sums are read from indexes alone, as there may be millions of jobs."""

tiles = Table(
    "tiles",
    metadata,
    Column("job", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("tile", Integer, primary_key=True),
    Column("state", String(16), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("seconds", Float),
    Column("losses", Integer, nullable=False, server_default="0"),  # how often its worker died or lost it
    Index("tiles_by_state", "job", "state"),
)

log = Table(
    "log",
    metadata,
    Column("line", Integer, primary_key=True, autoincrement=True),
    Column("job", ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("at", Float, nullable=False),
    Column("text", Text, nullable=False),
)

coordinator = Table(
    "coordinator",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("token", Integer, nullable=False),  # grows by one at each takeover
    Column("holder", String(64)),  # the process that runs the jobs
    Column("expires_at", Float, nullable=False),
    Column("beat_at", Float, nullable=False),
    Column("cluster", JSON, nullable=False),  # as the holder last saw it: workers, problem
)
"""One row: the lease of the coordinator, with times by the database's clock. See `storage.records.leases`."""

installation = Table(
    "installation",
    metadata,
    Column("id", String(32), primary_key=True),
)
"""One row: what the store of this database is recognised by. See `storage.installation`."""

totals = Table(
    "totals",
    metadata,
    Column("kind", String(16), primary_key=True),
    Column("tiles", BigInteger, nullable=False),
    Column("misses", BigInteger, nullable=False),
    Column("losses", BigInteger, nullable=False),
    Column("pixels", BigInteger, nullable=False),
    Column("seconds", Float, nullable=False),
)
"""Work done so far by each kind of job, deleted jobs included: for metrics."""

uploads = Table(
    "uploads",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("key", String(256)),
    Column("offset", BigInteger, nullable=False),
    Column("length", BigInteger, nullable=False),
    Column("parts", Integer, nullable=False),
    Column("metadata", Text, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float, nullable=False, index=True),
    _owner(),
    Column("moved_at", Float, nullable=False, server_default="0"),  # when it was created, or bytes last came
    UniqueConstraint("owner", "key"),
)

bodies = Table(
    "bodies",
    metadata,
    Column("id", String(32), primary_key=True),
    Column(
        "upload", ForeignKey("uploads.id", ondelete="CASCADE"), unique=True
    ),  # null for one outside of uploads
    Column("length", BigInteger, nullable=False),  # bytes that are expected at least
    Column("bytes", BigInteger, nullable=False),  # of these, reserved
    Column("stored", BigInteger, nullable=False),  # of these, on the disk when the row was last renewed
    Column("renewed_at", Float, nullable=False),
    Column("wanted_at", Float),  # when another request asked for the upload
    _owner(),
)
"""Bodies of requests under way, and the bytes reserved for each. See `storage.records.bodies`."""

upload_parts = Table(
    "upload_parts",
    metadata,
    Column("upload", ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True),
    Column("offset", BigInteger, primary_key=True),
    Column("name", String(32), nullable=False),
    Column("size", BigInteger, nullable=False),
)

deliveries = Table(
    "deliveries",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("job", String(32), nullable=False),  # may be deleted before the delivery
    Column("url", Text, nullable=False),
    Column("body", Text, nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("due_at", Float, nullable=False, index=True),
    Column("created_at", Float, nullable=False),
)
"""Webhook deliveries that are still to be made. See `storage.records.webhook_deliveries`."""

made = Table(
    "made",
    metadata,
    _owner(primary_key=True),
    Column("key", String(256), primary_key=True),
    Column("call", String(64), primary_key=True),
    Column("id", String(32), nullable=False),
)
"""What each Idempotency-Key has created, so that a repeated request gets the same response."""

keys = Table(
    "keys",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("name", Text, nullable=False),
    Column("hash", String(64), nullable=False, unique=True),
    Column("owner", String(64), nullable=False),
    Column("scope", String(8), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("revoked_at", Float),
)
"""API keys. See `storage.records.api_keys`."""

links = Table(
    "links",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("hash", String(64), nullable=False, unique=True),
    Column("matte", ForeignKey("mattes.id", ondelete="CASCADE"), nullable=False, index=True),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float, nullable=False, index=True),
    _owner(),
)
"""Links that let anyone see one matte. See `storage.records.links`."""
