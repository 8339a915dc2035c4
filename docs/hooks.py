"""Hooks of MkDocs: add to the site what lies outside docs/ (figures, docstrings, the notebook, the changelog).

Marks in the pages say where it goes: ``<!-- docstring: NAME -->`` becomes a class's docstring,
``<!-- arguments: NAME -->`` a table of a dataclass's fields with their defaults, ``<!-- ids -->`` the list of
registered environments, ``<!-- include: PATH -->`` a file of the repository.

The notebook is stored with its outputs: docs/renew_notebook.py.
"""

import ast
import base64
import dataclasses
import functools
import importlib
import inspect
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import sd_friction_env

ROOT = Path(__file__).resolve().parent.parent
BORROWED = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md", "agents.md": "agents/README.md"}
NOTEBOOK = "tour.ipynb"
# The folders that a user imports from, as the navigation calls them.
ROOMS = {
    "physics": "Physics",
    "environments": "Environments",
    "control": "Controllers",
    "pictures": "Pictures",
    "learning": "Learning",
}

_ENTRY_NAMES = r"((?:\*{0,2}\w+, )*\*{0,2}\w+)"
_SHARED_LINE = re.compile(rf"(?<=\.) {_ENTRY_NAMES}: ")
_SHARED_ENTRY = re.compile(rf"^    {_ENTRY_NAMES}(: .*(?:\n {{5,}}\S.*)*)", re.M)
_ROLE = re.compile(r":(?:attr|class|func|meth|mod):<code>([^<]+)</code>")


def modules(rooms: Iterable[str] = ROOMS) -> list[str]:
    """Return the dotted names of the public modules in these folders."""
    paths = [path for room in rooms for path in sorted((ROOT / "sd_friction_env" / room).glob("**/[!_]*.py"))]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]


class Described(NamedTuple):
    """A public name: where it is defined, and the first paragraph of its docstring."""

    full_name: str
    summary: str


@functools.cache
def public_names() -> dict[str, Described]:
    """Return modules, classes, methods and functions by the names that docstrings use for them."""
    names: dict[str, Described] = {}

    def add(name: str, full_name: str, docstring: str | None) -> None:
        names[name] = Described(full_name, " ".join((docstring or "").strip().partition("\n\n")[0].split()))

    for module in modules():
        tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8"))
        add(module, module, ast.get_docstring(tree))
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                add(node.name, f"{module}.{node.name}", ast.get_docstring(node))
            for part in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(part, ast.FunctionDef):
                    name = f"{node.name}.{part.name}"
                    add(name, f"{module}.{name}", ast.get_docstring(part))
    for path in sd_friction_env._MODULES.values():  # a package's page is that of its first module
        package = f"sd_friction_env.{path}"
        if package not in names:
            first = next(name for name in modules() if name.startswith(f"{package}."))
            add(package, first, importlib.import_module(package).__doc__)
    for name, path in sd_friction_env._PUBLIC.items():
        if name not in names:  # defined in the kernel, shown where it is imported from
            add(name, f"sd_friction_env.{path}.{name}", inspect.getdoc(getattr(sd_friction_env, name)))
    return names


def overview() -> str:
    """Return the page of the names that ``sd_friction_env`` offers at its top level, folder by folder."""
    found = {name: public_names().get(name) for name in sd_friction_env.__all__}
    found |= {name: public_names()[f"sd_friction_env.{path}"] for name, path in sd_friction_env._MODULES.items()}
    parts = [
        "# API",
        "Import these names from the top level: `from sd_friction_env import simulate`.",
        "The pages on the left hold everything else, one module each.",
    ]
    for room, title in ROOMS.items():
        parts += [f"## {title}", "| name | what it is |\n|---|---|"]
        for name, described in found.items():
            if described and described.full_name.startswith(f"sd_friction_env.{room}."):
                summary = described.summary.replace("|", "&#124;")
                parts[-1] += f"\n| [`{name}`][{described.full_name}] | {summary} |"
    return "\n\n".join(parts)


class Entries(griffe.Extension):
    """Give each name in a docstring an entry of its own, which is how griffe wants them.

    Ours may share a description ("x, v: the state") or a line ("dt: time between samples. hold: of each value").
    """

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring is None:
            return
        known = set(obj.members) | {parameter.name for parameter in getattr(obj, "parameters", ())}

        def own_line(entry: re.Match[str]) -> str:
            names = entry[1].replace("*", "").split(", ")
            return f"\n    {entry[1]}: " if all(name in known or name.endswith("Error") for name in names) else entry[0]

        def own_entry(entry: re.Match[str]) -> str:
            return "\n".join(f"    {name}{entry[2]}" for name in entry[1].split(", "))

        lines = obj.docstring.value.split("\n")
        lines = [_SHARED_LINE.sub(own_line, line) if line.startswith("    ") else line for line in lines]
        obj.docstring.value = _SHARED_ENTRY.sub(own_entry, "\n".join(lines))


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
    """Give every module its place in the navigation, below the title of its folder."""
    for section in config.nav or ():
        if "API" in section:
            section["API"] = [{"Overview": "api/index.md"}]
            for room, title in ROOMS.items():
                pages = [{module.split(".", 2)[2]: f"api/{module}.md"} for module in modules([room])]
                section["API"].append({title: pages})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what lies outside docs/, and the generated pages."""
    for path in sorted((ROOT / "figures").iterdir()):
        if path.suffix in (".png", ".svg", ".gif"):
            files.append(File.generated(config, f"figures/{path.name}", abs_src_path=str(path)))
    for name, source in BORROWED.items():
        files.append(File.generated(config, name, abs_src_path=str(ROOT / source)))
    files.append(File.generated(config, "api/index.md", content=overview()))
    for module in modules():
        files.append(File.generated(config, f"api/{module}.md", content=f"::: {module}\n"))
    page, pictures = notebook_page(ROOT / "docs" / NOTEBOOK)
    files.append(File.generated(config, NOTEBOOK.replace(".ipynb", ".md"), content=page))
    for name, picture in pictures.items():
        files.append(File.generated(config, f"figures/{name}", content=picture))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the marks; what lies beside docs/ in the repository lies among the pages in the site."""
    markdown = expanded(markdown)
    for place, source in [("figures/", "figures/"), *BORROWED.items()]:
        markdown = re.sub(rf"\]\(\.\./((?:\.\./)*){re.escape(source)}", rf"](\g<1>{place}", markdown)
    return markdown


def on_page_content(html: str, **_: Any) -> str:
    """Turn the roles in docstrings, such as :class:`Task`, into links."""

    def link(role: re.Match[str]) -> str:
        target = public_names().get(role[1].lstrip("~"))
        code = f"<code>{role[1]}</code>"
        return f'<autoref identifier="{target.full_name}" optional>{code}</autoref>' if target else code

    return _ROLE.sub(link, html)
