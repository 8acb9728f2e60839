"""Help text of config fields: their docstrings without line breaks.

By itself, tyro keeps the line breaks of docstrings whose continuation lines are indented.
"""

import dataclasses
import functools
from typing import Annotated, Any, get_type_hints

import docstring_parser
import tyro
from tyro.constructors import StructConstructorSpec, StructFieldSpec, StructTypeInfo

REGISTRY = tyro.constructors.ConstructorRegistry()
"""Pass this to `tyro.cli` together with a default instance. Where the default of a dataclass is
None, tyro's own rules apply."""


@REGISTRY.struct_rule
def _fields(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Describe a dataclass to tyro."""
    if not dataclasses.is_dataclass(info.type) or not isinstance(info.default, info.type):
        return None
    types = get_type_hints(info.type, include_extras=True)
    fields = (
        StructFieldSpec(
            field.name,
            _with_bounds(types[field.name]),
            getattr(info.default, field.name),
            helptext=functools.partial(_text, info.type, field.name),
        )
        for field in dataclasses.fields(info.type)
        if field.init
    )
    return StructConstructorSpec(instantiate=info.type, fields=tuple(fields))


def _with_bounds(kind: Any) -> Any:
    """Return the type of a field; the help text names the two values of a range."""
    if kind == tuple[float, float]:
        return Annotated[kind, tyro.conf.arg(metavar="LOW HIGH")]
    return kind


def _text(owner: type, name: str) -> str | None:
    """Return the docstring of a field on one line."""
    for kind in owner.__mro__[:-1]:
        for field in docstring_parser.parse_from_object(kind).params:
            if field.arg_name == name and field.description:
                return " ".join(field.description.split())
    return None
