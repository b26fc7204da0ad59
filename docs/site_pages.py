"""Pages of the documentation site that are made from other files: overview, contributing, decisions, references.

mkdocs loads this file as a hook; see mkdocs.yml. The references of the command line, the REST API and the settings are
made from the program itself; the Python reference is read from the sources.
"""

import ast
import re
from pathlib import Path

import site_commands
import site_rest
import site_scripts
import site_settings
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PACKAGES = (ROOT / "spiked", ROOT / "driver" / "spiked_driver")


def exported(file: Path) -> list[str]:
    """The names in `__all__` of a module."""
    for node in ast.parse(file.read_text()).body:
        match node:
            case ast.Assign(targets=[ast.Name(id="__all__")], value=value):
                return list(ast.literal_eval(value))
    return []


def public_modules() -> dict[str, Path]:
    """The files of the public modules by name: modules and packages with `__all__`, one level deep, and the operators
    of torch, which nothing else imports."""
    found = {}
    for package in PACKAGES:
        for file in sorted([*package.glob("*.py"), *package.glob("*/__init__.py"), *package.glob("render/torch.py")]):
            if exported(file):
                parts = file.with_suffix("").relative_to(package.parent).parts
                found[".".join(part for part in parts if part != "__init__")] = file
    return found


def module_page(module: str, file: Path) -> str:
    """Markdown of one module: its docstring, then every name in `__all__`."""
    parts = [f"# {module}", docstring(file), *(f"::: {module}.{name}" for name in exported(file))]
    return "\n\n".join(parts) + "\n"


def docstring(file: Path) -> str:
    """Docstring of a module."""
    return ast.get_docstring(ast.parse(file.read_text())) or ""


def reference_index(modules: dict[str, Path]) -> str:
    """Markdown of the list of modules, each with the first paragraph of its docstring."""
    rows = []
    for module, file in modules.items():
        summary = docstring(file).split("\n\n")[0].replace("\n", " ")
        rows.append(f"| [`{module}`]({module}.md) | {summary} |")
    head = "# Python reference\n\nPublic are the names below; everything else may change in any release.\n"
    return "\n".join([head, "| module | contents |", "|---|---|", *rows, ""])


def decision_index() -> str:
    """Markdown of the list of decision records with their status."""
    rows = []
    for file in sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md")):
        text = file.read_text()
        title = re.search(r"^# (?:\d+[.:]? *)?(.+)$", text, re.MULTILINE)
        status = re.search(r"^Status: (.+?)\.?$", text, re.MULTILINE)
        assert title is not None and status is not None, f"{file.name}: give it a title and a line 'Status: ...'"
        rows.append(f"| {int(file.name[:4])} | [{title[1]}]({file.name}) | {status[1]} |")
    return "\n".join(["# Decisions", "", "| | decision | status |", "|---|---|---|", *rows, ""])


def at_root(text: str) -> str:
    """A page that lies beside docs/, with its links as they are from inside docs/."""
    links = {
        "docs/decisions": "decisions/index.md",
        "CONTRIBUTING.md": "contributing.md",
        "README.md": "index.md",
        "CHANGELOG.md": "changelog.md",
    }

    def moved(match: re.Match[str]) -> str:
        target = match[1]
        return f"]({links.get(target, target.removeprefix('docs/'))})"

    return re.sub(r"\]\(([^)\s]+)\)", moved, text)


def generated() -> dict[str, str]:
    """Every generated page: path below docs/ and Markdown."""
    modules = public_modules()
    return {
        "index.md": at_root((ROOT / "README.md").read_text()),
        "contributing.md": at_root((ROOT / "CONTRIBUTING.md").read_text()),
        "changelog.md": at_root((ROOT / "CHANGELOG.md").read_text()),
        "decisions/index.md": decision_index(),
        "reference/index.md": reference_index(modules),
        **{f"reference/{module}.md": module_page(module, file) for module, file in modules.items()},
        **site_commands.pages(),
        **site_rest.pages(),
        **site_settings.pages(),
    }


def reference_navigation() -> list[object]:
    """The navigation of everything that is generated below `reference`."""
    rest = [{path.rsplit("/", 1)[1].removesuffix(".md").capitalize(): path} for path in site_rest.pages()]
    commands = [{words: site_commands.path_of(words)} for words in site_commands.commands() if words != "spiked"]
    return [
        {"Command line": [site_commands.path_of("spiked"), *commands]},
        {"REST": [next(iter(rest[0].values())), *rest[1:]]},
        {"Settings": site_settings.SETTINGS},
        {"Sources": site_settings.SOURCES},
        {"Python": ["reference/index.md", *({name: f"reference/{name}.md"} for name in public_modules())]},
    ]


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the generated references to the navigation."""
    assert config.nav is not None
    (reference,) = (section["Reference"] for section in config.nav if "Reference" in section)
    reference[:0] = reference_navigation()
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, and the scripts that are files of their own."""
    for path, text in generated().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Take scripts out of the page: see site_scripts."""
    return site_scripts.without_inline(output, Path(config.site_dir), page.file.url)


def on_post_build(config: MkDocsConfig) -> None:
    """Write the script of the search from disk, and remove what nothing reads."""
    site_scripts.finish(Path(config.site_dir))
