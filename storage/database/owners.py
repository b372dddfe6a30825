"""Whose things are whose, by one rule: what is done over an engine that is bound to an owner concerns his rows alone.

`bound` gives such an engine. Of whatever statement is executed over it the listener here narrows every table: one with
a column ``owner`` to the rows of that owner, one that refers to such a table to the rows that belong to those, and what
is inserted is his. So no query, and no route, can forget to ask. What can't be narrowed with certainty is refused with
a `TypeError`, for it is a fault of ours: text, tables of the whole service, subqueries. An outer join becomes an inner
one.

An engine that is not bound sees the rows of all owners: it is for the coordinator, and for whoever runs the service.
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
"""Whose everything is in a service without keys, by keys of the settings, and from before there were owners."""
NOBODY = ""
"""An owner of nothing."""
SHARED = {"coordinator"}
"""Tables that tell nothing of anyone's, and that all may see."""
SECRET = {"keys"}
"""Tables that no owner may see, though every row has one."""

E = TypeVar("E", bound=Executable)


def for_owner(engine: Engine, owner: str) -> Engine:
    """The same engine, over which only what belongs to an owner can be seen, changed and made."""
    return engine.execution_options(owner=owner)


def across_owners(statement: E) -> E:
    """A statement that concerns the rows of all owners, whoever executes it: for sums that no row can be told from."""
    statement = statement.execution_options(of_all=True)
    return statement


def default_owner(context: Any) -> str:
    """Whose a row is that is inserted: the default of every column ``owner``."""
    owner: str = context.execution_options.get("owner", DEFAULT)
    return owner


def restrict(
    connection: Connection, statement: Any, several: Any, parameters: Any, options: Any
) -> tuple[Any, Any, Any]:
    """Narrow a statement to the owner that its connection is bound to: a listener to ``before_execute``."""
    owner = options.get("owner")
    if owner is not None and not options.get("of_all"):
        statement = _narrowed(statement, owner)
    return statement, several, parameters


def _narrowed(statement: Any, owner: str) -> Any:
    tables = _tables_of(statement)
    if isinstance(statement, Insert):
        return statement
    for table in tables:
        mine = _mine(table, owner)
        if mine is not None:
            statement = statement.where(mine)
    return statement


def _tables_of(statement: Any) -> list[Table]:
    """The tables that a statement reads or writes.

    Raises
    ------
    TypeError
        If a criterion on each of them would not do.
    """
    if not isinstance(statement, (Select, Insert, Update, Delete)):
        raise TypeError(f"an owner's statement is a select, insert, update or delete, not {type(statement)}")
    tables: dict[Table, None] = {}
    for element in visitors.iterate(statement):
        if isinstance(element, Table):
            tables[element] = None
        elif isinstance(element, (SelectBase, AliasedReturnsRows, TextClause)) and element is not statement:
            raise TypeError(f"an owner's statement has no {type(element)} in it: it could not be narrowed")
    return list(tables)


def _mine(table: Table, owner: str) -> ColumnElement[bool] | None:
    """What is true of the rows of a table that belong to an owner; None where all may see all of them."""
    if table.name in SHARED:
        return None
    if "owner" in table.c and table.name not in SECRET:
        return table.c.owner == owner
    for key in table.foreign_keys:
        parent = key.column.table.alias()
        if "owner" in parent.c:
            return exists().where(parent.c[key.column.name] == key.parent, parent.c.owner == owner)
    raise TypeError(f"the table {table.name} is of the whole service, and no owner's")
