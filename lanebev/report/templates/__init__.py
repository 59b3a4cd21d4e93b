"""The templates of pages; values in them are escaped."""

from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined, Template


@cache
def template(name: str) -> Template:
    """Return a template by the name of its file."""
    environment = Environment(
        loader=PackageLoader("lanebev.report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.policies["json.dumps_kwargs"] = {
        "sort_keys": False,
        "allow_nan": False,
    }  # Bokeh's have an order
    return environment.get_template(name)
