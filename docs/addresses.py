"""
Copy what a release is built from, with the repository's address in it: `python docs/addresses.py ADDRESS FOLDER`.

PyPI shows README without the files beside it. So in the copy that this makes in an empty folder, README's links and images
lead to the repository at the version's tag, `pyproject.toml` has project URLs and `CITATION.cff` names the repository.
The paths are GitHub's, `ADDRESS/blob/TAG/FILE` and `ADDRESS/raw/TAG/FILE`.
"""

import argparse
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("sb3_dtfm", "envs", "zoo_configs")
FILES = ("*.md", "*.toml", "*.cff", "*.in", "LICENSE", "constraints*.txt")
# A link or an image: its exclamation mark, its text, the file beside README that it leads to, and the place in that file.
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|#)([^)#\s]+)(#[^)\s]*)?\)")


def copy_with_address(address: str, folder: Path) -> None:
    """
    :param address: of the repository, such as https://github.com/OWNER/sb3_dtfm
    :param folder: to make
    :raises ValueError: the address is none of a web page, or README links a file that is not there
    :raises FileExistsError: the folder is there already
    """
    address = address.rstrip("/")
    if not re.fullmatch(r"https://[\w.-]+(/[\w.-]+){2}", address):
        raise ValueError(f"The address is {address!r}; accepted is one such as https://github.com/OWNER/sb3_dtfm.")
    folder.mkdir(parents=True)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for file in {file for pattern in FILES for file in ROOT.glob(pattern)}:
        shutil.copy2(file, folder)

    tag = "v" + re.findall(r'^__version__ = "(.+)"', (ROOT / "sb3_dtfm/__init__.py").read_text(), re.MULTILINE)[0]

    def absolute(link: re.Match[str]) -> str:
        image, text, target, place = link.groups(default="")
        if not (ROOT / target).exists():
            raise ValueError(f"README.md links {target}, which is not there.")
        return f"{image}[{text}]({address}/{'raw' if image else 'blob'}/{tag}/{target}{place})"

    readme = folder / "README.md"
    readme.write_text(LINK.sub(absolute, readme.read_text()))
    urls = {
        "Source": address,
        "Documentation": f"{address}/blob/{tag}/docs/index.md",
        "Changelog": f"{address}/blob/{tag}/CHANGELOG.md",
        "Issues": f"{address}/issues",
    }
    with (folder / "pyproject.toml").open("a") as project:
        project.write("\n[project.urls]\n" + "".join(f'{name} = "{url}"\n' for name, url in urls.items()))
    with (folder / "CITATION.cff").open("a") as citation:
        citation.write(f'repository-code: "{address}"\n')


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", help="https://github.com/OWNER/NAME")
    parser.add_argument("folder", type=Path, help="to be made")
    options = parser.parse_args()
    try:
        copy_with_address(options.address, options.folder)
    except (ValueError, FileExistsError) as error:
        sys.exit(str(error))
