"""Hook of mkdocs: show Sphinx roles of docstrings as code, with a link where the name is documented."""

import re
from typing import Any

_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod):<code>(~?)([\w.]+)</code>")


def on_page_content(html: str, **_: Any) -> str:
    """Replace the roles in a page; ``~`` before a name shows its last part only, as in Sphinx."""

    def shown(role: re.Match[str]) -> str:
        short, name = role.groups()
        text = name.rpartition(".")[2] if short else name
        return f'<autoref identifier="{name}" optional><code>{text}</code></autoref>'

    return _ROLE.sub(shown, html)
