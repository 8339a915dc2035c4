"""What the documentation takes from elsewhere: figures, docstrings, the notebook, the changelog (hooks of MkDocs).

Pages say where: ``<!-- docstring: NAME -->`` becomes a class's docstring, ``<!-- arguments: NAME -->``
a table of a dataclass's fields with their defaults, ``<!-- ids -->`` the list of registered environments,
``<!-- include: PATH -->`` a file of the repository.

The notebook is kept with its outputs: docs/renew_notebook.py.
"""

import ast
import base64
import dataclasses
import functools
import inspect
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import sd_friction_env

ROOT = Path(__file__).resolve().parent.parent
BORROWED = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
NOTEBOOK = "tour.ipynb"

_ROLE = re.compile(r":(?:attr|class|func|meth|mod):<code>([^<]+)</code>")


def modules() -> list[str]:
    """Return the dotted names of all public modules."""
    paths = sorted((ROOT / "sd_friction_env").glob("**/[!_]*.py"))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]


@functools.cache
def public_names() -> dict[str, str]:
    """Return the full names of modules, classes, methods and functions by what docstrings call them."""
    names = {}
    for module in modules():
        names[module] = module
        tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                names[node.name] = f"{module}.{node.name}"
            if isinstance(node, ast.ClassDef):
                methods = [part.name for part in node.body if isinstance(part, ast.FunctionDef)]
                names |= {f"{node.name}.{name}": f"{module}.{node.name}.{name}" for name in methods}
    return names


def attributes_of(kind: type) -> dict[str, str]:
    """Return what the "Attributes" part of a dataclass's docstring says of each field.

    Raises:
        ValueError: if a field is missing there.
    """
    section = re.search(r"^Attributes:\n((?:    .*\n|\n)+)", inspect.getdoc(kind) or "", re.M)
    said = {}
    for entry in re.split(r"\n    (?=\S)", "\n" + section[1].rstrip()) if section else ():
        names, _, meaning = entry.partition(": ")
        said |= {name.strip(): " ".join(meaning.split()) for name in names.split(",")}
    missing = [field.name for field in dataclasses.fields(kind) if field.name not in said]
    if missing:
        raise ValueError(f"the docstring of {kind.__name__} says nothing of {missing[0]!r}")
    return said


def argument_table(name: str) -> str:
    """Return the fields of a dataclass of the package, their defaults and meanings, as a Markdown table."""
    kind = getattr(sd_friction_env, name)
    said = attributes_of(kind)
    rows = ["| argument | default | meaning |", "|---|---|---|"]
    for field in dataclasses.fields(kind):
        default = {} if field.default is dataclasses.MISSING else field.default
        rows.append(f"| `{field.name}` | `{default!r}` | {said[field.name].replace('|', '&#124;')} |")
    return "\n".join(rows)


def expanded(markdown: str) -> str:
    """Return a page's Markdown with its marks replaced by what they stand for."""
    markdown = re.sub(r"<!-- arguments: (\w+) -->", lambda mark: argument_table(mark[1]), markdown)
    markdown = re.sub(
        r"<!-- docstring: (\w+) -->",
        lambda mark: inspect.getdoc(getattr(sd_friction_env, mark[1])) or "",
        markdown,
    )
    markdown = re.sub(r"<!-- include: (\S+) -->", lambda mark: (ROOT / mark[1]).read_text(encoding="utf-8"), markdown)
    ids = "\n".join(f"- `{env_id}`" for env_id in sd_friction_env.ENVIRONMENT_IDS)
    return markdown.replace("<!-- ids -->", ids)


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown with its stored outputs, and the pictures that it then shows, by name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                name = f"{path.stem}_{len(pictures)}.png"
                pictures[name] = base64.b64decode("".join(output["data"]["image/png"]))
                parts.append(f"![What this cell draws](figures/{name})")
            elif output["output_type"] == "stream":
                parts.append(f"```text\n{''.join(output['text'])}```")
    note = f"This page is a notebook, [{path.name}]({path.name}): in a copy of the repository it runs as it is."
    title, _, rest = parts[0].partition("\n")
    return "\n\n".join([title, note, rest, *parts[1:]]), pictures


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Give every module its place in the navigation."""
    for entry in config.nav or ():
        if "API" in entry:
            entry["API"] = [{module: f"api/{module}.md"} for module in modules()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies outside docs/, and the pages that are made."""
    for path in sorted((ROOT / "figures").glob("*.png")):
        files.append(File.generated(config, f"figures/{path.name}", abs_src_path=str(path)))
    for name, source in BORROWED.items():
        files.append(File.generated(config, name, abs_src_path=str(ROOT / source)))
    for module in modules():
        files.append(File.generated(config, f"api/{module}.md", content=f"::: {module}\n"))
    page, pictures = notebook_page(ROOT / "docs" / NOTEBOOK)
    files.append(File.generated(config, NOTEBOOK.replace(".ipynb", ".md"), content=page))
    for name, picture in pictures.items():
        files.append(File.generated(config, f"figures/{name}", content=picture))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the marks; figures lie beside the pages in the site, and beside docs/ in the repository."""
    return re.sub(r"\]\(\.\./((?:\.\./)*figures/)", r"](\1", expanded(markdown))


def on_page_content(html: str, **_: Any) -> str:
    """Make links of the roles in docstrings, such as :class:`Task`."""

    def link(role: re.Match[str]) -> str:
        target = public_names().get(role[1].lstrip("~"))
        code = f"<code>{role[1]}</code>"
        return f'<autoref identifier="{target}" optional>{code}</autoref>' if target else code

    return _ROLE.sub(link, html)
