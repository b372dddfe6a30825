"""Row-level access: over an engine that is bound to an owner, statements see and change only that owner's rows.

`for_owner` returns such an engine. A listener rewrites every statement that is executed over it: a table with a column
``owner`` is restricted to the owner's rows, a table with a foreign key to such a table to the rows that belong to
those, and inserted rows get the owner. So no query and no route can forget the check. A statement that cannot be
restricted with certainty raises `TypeError`, because it is a programming error: text, tables of the whole service,
subqueries. An outer join becomes an inner join.

An engine without an owner sees the rows of all owners. The coordinator and the command line use it.
"""

from typing import Any, TypeVar

from sqlalchemy import (
    ColumnElement,
    Connection,
    Delete,
    Engine,
    Executable,
    Insert,
    Select,
    Table,
    TextClause,
    Update,
    exists,
)
from sqlalchemy.sql import visitors
from sqlalchemy.sql.selectable import AliasedReturnsRows, SelectBase

DEFAULT = "default"
"""The owner of everything in a service without keys, of keys from the settings, and of rows older than owners are."""
NOBODY = ""
"""An owner that owns nothing."""
SHARED = {"coordinator"}
"""Tables that hold nothing of any owner and that every owner may read."""
SECRET = {"keys"}
"""Tables that no owner may read, although their rows have an owner."""

E = TypeVar("E", bound=Executable)


def for_owner(engine: Engine, owner: str) -> Engine:
    """The same engine, restricted to reading, changing and inserting rows of one owner."""
    return engine.execution_options(owner=owner)


def across_owners(statement: E) -> E:
    """The same statement over the rows of all owners: for sums, which reveal no single row."""
    statement = statement.execution_options(across_owners=True)
    return statement


def default_owner(context: Any) -> str:
    """The owner of an inserted row: the default of every column ``owner``."""
    owner: str = context.execution_options.get("owner", DEFAULT)
    return owner


def restrict(
    connection: Connection, statement: Any, several: Any, parameters: Any, options: Any
) -> tuple[Any, Any, Any]:
    """Listener to ``before_execute``: restrict a statement to the owner that its engine is bound to."""
    owner = options.get("owner")
    if owner is not None and not options.get("across_owners"):
        statement = _restricted(statement, owner)
    return statement, several, parameters


def _restricted(statement: Any, owner: str) -> Any:
    tables = _tables_of(statement)
    if isinstance(statement, Insert):
        return statement
    for table in tables:
        condition = _owned(table, owner)
        if condition is not None:
            statement = statement.where(condition)
    return statement


def _tables_of(statement: Any) -> list[Table]:
    """The tables that a statement reads or writes.

    Raises
    ------
    TypeError
        If a condition on each of them would not restrict the statement.
    """
    if not isinstance(statement, (Select, Insert, Update, Delete)):
        raise TypeError(f"an owner may only select, insert, update and delete, not execute {type(statement)}")
    tables: dict[Table, None] = {}
    for element in visitors.iterate(statement):
        if isinstance(element, Table):
            tables[element] = None
        elif isinstance(element, (SelectBase, AliasedReturnsRows, TextClause)) and element is not statement:
            raise TypeError(
                f"an owner's statement must not contain {type(element)}, which cannot be restricted"
            )
    return list(tables)


def _owned(table: Table, owner: str) -> ColumnElement[bool] | None:
    """The condition that selects an owner's rows of a table; None for a table that every owner may read."""
    if table.name in SHARED:
        return None
    if "owner" in table.c and table.name not in SECRET:
        return table.c.owner == owner
    for key in table.foreign_keys:
        parent = key.column.table.alias()
        if "owner" in parent.c:
            return exists().where(parent.c[key.column.name] == key.parent, parent.c.owner == owner)
    raise TypeError(f"the table {table.name} belongs to the whole service, not to an owner")
