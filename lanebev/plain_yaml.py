"""YAML whose numbers and dates stay texts, and in which each key is given once."""

import re
from collections.abc import Iterable, Iterator
from typing import Any

import yaml

from lanebev.numbers import shown


class PlainLoader(yaml.SafeLoader):
    """SafeLoader that leaves all scalars but null as texts, and refuses a key given twice.

    YAML 1.1 would make 416 of a width of 0640, 510 of a drive 8:30, and false of a road called No.
    """

    yaml_implicit_resolvers = {}  # noqa: RUF012 - so it is in the base class

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping, with the keys as they are written."""
        if not isinstance(node, yaml.MappingNode):
            raise ValueError(f"expected keys and values at line {node.start_mark.line + 1}, got none")
        if not all(isinstance(key, yaml.ScalarNode) for key, _ in node.value):
            raise ValueError("expected plain keys, got a list or a mapping as a key")
        once((key.value, None) for key, _ in node.value)
        self.flatten_mapping(node)
        return {key.value: self.construct_object(value, deep=deep) for key, value in node.value}


PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:null", re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]
)


def plain_documents(text: str, loader: type[PlainLoader]) -> Iterator[Any]:
    """Yield what each document of a YAML text says.

    Raises:
        yaml.YAMLError: the text is none.
        ValueError: a key is given twice, or is none.
    """
    reader: Any = loader(text)  # PyYAML types not all of its methods
    try:
        while reader.check_data():
            yield reader.get_data()
    finally:
        reader.dispose()


def once(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs as a dict; a repeated key is an error."""
    fields: dict[str, Any] = {}
    for key, value in pairs:
        if key in fields:
            raise ValueError(f"expected each key once, got {shown(key)} twice")
        fields[key] = value
    return fields
