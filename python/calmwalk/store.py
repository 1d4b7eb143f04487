"""Read-only connections to the store of a campaign: SQLite in its directory, or PostgreSQL on a server."""

from __future__ import annotations

import os
import sqlite3
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import parse_qsl, quote, urlencode, urlsplit, urlunsplit

from .checksums import Row
from .store_errors import DamagedError, MissingCampaign, MissingPackage, SchemaError, StoreError

DATABASE = "campaign.sqlite"
# `PRAGMA application_id` of a campaign: "CALM".
APPLICATION = 0x43414C4D
# Versions of the tables that this package reads. Those before have other words and columns, those after are not known.
OLDEST_SCHEMA, NEWEST_SCHEMA = 16, 22
# Time for which SQLite waits for a lock, s.
_BUSY_TIMEOUT = 10.0
# The tables have the keyword STRICT.
_OLDEST_SQLITE = (3, 37, 0)


class Store(Protocol):
    """A database that can be read. Queries have ``?`` for parameters, and SQL that both databases know."""

    location: str
    """Directory, or URL without its password."""
    schema: int
    """Version of the tables."""

    def rows(self, sql: str, parameters: Iterable[Any] = ()) -> list[Row]:
        """All rows of a query."""

    def close(self) -> None:
        """Close the connection."""


def open_store(location: str | os.PathLike[str]) -> Store:
    """Open the store in a directory or at a ``postgres://`` URL, and check the version of its tables."""
    text = os.fspath(location)
    if text.startswith(("postgres://", "postgresql://")):
        return PostgresStore(text)
    return _open_directory(Path(text))


def pages(store: Store, sql: str, key: str, parameters: Iterable[Any] = (), size: int = 500) -> Iterator[Row]:
    """The rows of a query in pages, so that a campaign of any size takes little memory and no page holds a lock.

    ``sql`` has the condition ``… > ?`` for the ascending column ``key`` as its last but one parameter, and ``LIMIT ?``.
    """
    after, fixed = -1, list(parameters)
    while page := store.rows(sql, [*fixed, after, size]):
        yield from page
        after = page[-1][key]


def check_schema(found: int, where: str) -> None:
    """Raise :class:`SchemaError` unless this package reads tables of this version."""
    reads = f"this package reads versions {OLDEST_SCHEMA} to {NEWEST_SCHEMA}"
    if found > NEWEST_SCHEMA:
        raise SchemaError(
            f"{where} has schema version {found}, and {reads}: install the package of a newer calmwalk"
        )
    if found < OLDEST_SCHEMA:
        raise SchemaError(
            f"{where} has schema version {found}, and {reads}: any calmwalk command that writes brings the campaign up to "
            "date, for example 'calmwalk run'; 'calmwalk store backup' makes a copy before"
        )


class SqliteStore:
    """A campaign in a directory. The file is opened with ``mode=ro``: nothing is written, also while the campaign runs."""

    def __init__(self, path: Path) -> None:
        self.location = str(path.parent)
        if sqlite3.sqlite_version_info < _OLDEST_SQLITE:
            raise StoreError(f"this Python has SQLite {sqlite3.sqlite_version}, expected 3.37 or later")
        self._path = path
        self._check_header()
        self._connection = sqlite3.connect(self._uri(), uri=True, timeout=_BUSY_TIMEOUT)
        self._connection.row_factory = sqlite3.Row
        try:
            self.schema = self._identify()
        except BaseException:
            self._connection.close()
            raise

    def rows(self, sql: str, parameters: Iterable[Any] = ()) -> list[Row]:
        try:
            return self._connection.execute(sql, tuple(parameters)).fetchall()
        except sqlite3.DatabaseError as error:
            raise _sqlite_error(self._path, error) from error

    def close(self) -> None:
        self._connection.close()

    def _uri(self) -> str:
        uri = f"file:{quote(str(self._path.resolve()))}?mode=ro"
        # Without a write-ahead log the file is complete; where nothing may be written, SQLite cannot lock it.
        log = self._path.with_name(DATABASE + "-wal")
        if not os.access(self._path.parent, os.W_OK) and not log.exists():
            uri += "&immutable=1"
        return uri

    def _check_header(self) -> None:
        with self._path.open("rb") as file:
            begin = file.read(16)
        if begin != b"SQLite format 3\0":
            raise SchemaError(f"{self._path} is not an SQLite database: it begins with {begin!r}")

    def _identify(self) -> int:
        application, version = (
            self.rows(f"PRAGMA {name}")[0][name] for name in ("application_id", "user_version")
        )
        if application != APPLICATION:
            raise SchemaError(
                f"{self._path} is a database of another program: application id {application:#x}, expected {APPLICATION:#x}"
            )
        check_schema(version, str(self._path))
        return int(version)


def _sqlite_error(path: Path, error: sqlite3.DatabaseError) -> StoreError:
    if isinstance(error, sqlite3.OperationalError) and "locked" in str(error):
        return StoreError(f"{path}: another process keeps it locked ({error})")
    kind = DamagedError if "malformed" in str(error) or "not a database" in str(error) else StoreError
    return kind(f"{path}: {error}")


def _open_directory(path: Path) -> Store:
    """The campaign in this directory, else the one whose configuration is in it, else the only one in its subdirectories:
    as the command line has it."""
    if path.name == DATABASE and path.is_file():
        return SqliteStore(path)
    if not path.exists():
        raise MissingCampaign(f"there is no campaign in {path}: the directory does not exist")
    if (path / DATABASE).is_file():
        return SqliteStore(path / DATABASE)
    found = _of_configurations(path) or sorted({str(file.parent) for file in path.glob(f"*/{DATABASE}")})
    if not found:
        raise MissingCampaign(f"there is no campaign in {path}: it has no {DATABASE}")
    if len(found) > 1:
        shown = ", ".join(_without_password(text) for text in found)
        raise MissingCampaign(f"{path} contains {len(found)} campaigns: name one of {shown}")
    return open_store(found[0])


def _of_configurations(directory: Path) -> list[str]:
    found = []
    for config in sorted(directory.glob("*.toml")):
        if (config.with_suffix("") / DATABASE).is_file():
            found.append(str(config.with_suffix("")))
            continue
        try:
            url = tomllib.loads(config.read_text()).get("run", {}).get("store", "")
        except (OSError, ValueError, AttributeError):
            continue
        if isinstance(url, str) and url.startswith(("postgres://", "postgresql://")):
            found.append(url)
    return found


class PostgresStore:
    """A campaign in a schema of a PostgreSQL server, read through psycopg in read-only transactions."""

    def __init__(self, url: str) -> None:
        try:
            import psycopg
            from psycopg.rows import dict_row
        except ImportError:
            raise MissingPackage(
                "a campaign on a PostgreSQL server needs psycopg: pip install 'psycopg[binary]'"
            ) from None
        self.location = _without_password(url)
        plain, schema = _without_schema(url)
        self._errors: type[Exception] = psycopg.Error
        try:
            self._connection: Any = psycopg.connect(plain, autocommit=True, row_factory=dict_row)
        except psycopg.Error as error:
            raise StoreError(f"cannot connect to {self.location}: {str(error).strip()}") from None
        try:
            self._connection.execute("SET default_transaction_read_only = on")
            self._connection.execute("SELECT set_config('search_path', %s, false)", [f'"{schema}"'])
            self.schema = self._identify(schema)
        except BaseException:
            self._connection.close()
            raise

    def rows(self, sql: str, parameters: Iterable[Any] = ()) -> list[Row]:
        try:
            cursor = self._connection.cursor(binary=True)
            return list(cursor.execute(sql.replace("?", "%s"), list(parameters)).fetchall())
        except self._errors as error:
            raise StoreError(f"{self.location}: {str(error).strip()}") from error

    def close(self) -> None:
        self._connection.close()

    def _identify(self, schema: str) -> int:
        tables = {
            row["tablename"]
            for row in self.rows("SELECT tablename FROM pg_tables WHERE schemaname = ?", [schema])
        }
        if not tables - {"_sqlx_migrations"}:
            raise MissingCampaign(
                f"there is no campaign in {self.location}: the schema '{schema}' has no tables"
            )
        if "leader" not in tables:
            raise SchemaError(
                f"the schema in {self.location} has a table '{min(tables)}' of another program, expected those of a campaign"
            )
        found = self.rows("SELECT max(version) AS version FROM _sqlx_migrations")[0]["version"]
        check_schema(found or 0, self.location)
        return int(found)


def _without_schema(url: str) -> tuple[str, str]:
    """The URL for libpq, and the schema that it names. An unprotected connection to another host must be asked for, as
    everywhere in calmwalk."""
    parts = urlsplit(url)
    parameters = parse_qsl(parts.query, keep_blank_values=True)
    schema = dict(parameters).get("schema", "public")
    kept = [(key, value) for key, value in parameters if key != "schema"]
    host = dict(parameters).get("host", parts.hostname or "")
    local = not host or host.startswith("/") or host in ("localhost", "::1") or host.startswith("127.")
    mode = dict(parameters).get("sslmode", os.environ.get("PGSSLMODE", "prefer"))
    if not local and mode in ("allow", "prefer"):
        raise StoreError(
            f"{_without_password(url)}: the server '{host}' is another host, so the connection must be protected: add "
            "sslmode=verify-full (sslmode=require encrypts without verifying the server; sslmode=disable is for a private "
            "network)"
        )
    return urlunsplit(parts._replace(query=urlencode(kept))), schema


def _without_password(url: str) -> str:
    parts = urlsplit(url)
    user, at, host = parts.netloc.rpartition("@")
    parameters = [
        (key, value) for key, value in parse_qsl(parts.query, keep_blank_values=True) if key != "password"
    ]
    return urlunsplit(
        parts._replace(netloc=user.partition(":")[0] + at + host, query=urlencode(parameters, safe="/"))
    )
