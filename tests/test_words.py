"""The project's words: those that an earlier version had are gone, and sentences begin with their subject."""

import ast
import io
import re
import subprocess
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Each as a whole word, whatever its case.
GONE = (
    # options and columns
    "calm_units", "return_weight", "return_steps", "timestep_exponent", "n_candidates", "candidate_noise", "n_solver_steps",
    "guided_share", "n_valued",
    # classes and functions
    "CorrectionVecEnv", "SteeredDTFM", "act_from_noise", "carry_out", "own_noise", "hand_out", "take_up", "threads_that_pay",
    "n_products", "from_first", "first_of_each_machine_first", "_memory_errors_named", "naming_the_file", "naming",
    "asking_for", "asked_for", "keep_pace", "finished_cells",
    "set_solver", "take_up_rows", "take_up_evaluations",
    # prose
    "guided", "steer", "steers", "steered", "steering", "gait", "gaits", "lucky", "luckiest", "peer", "peers", "in sight",
    "what is asked for", "what is seen", "likewise", "goes on online", "going on online", "small profile", "drowns",
    "return to ask for", "target's pace", "ladder", "go on learning", "goes on learning", "going on learning",
    "go on imitating", "goes on imitating", "times of learning", "attempts succeeded", "door of people", "can-few", "regime",
    "regimes", "calm", "candidates", "corrections", "rooms",
)  # fmt: skip
WORD = re.compile(rf"(?<!\w)_?({'|'.join(GONE)})(?!\w)", re.IGNORECASE)
FOLDERS = ("sb3_dtfm", "envs", "zoo_configs", "tests", "studies", "examples", "docs")
# Words that begin no sentence but a question.
ASKS = re.compile(r"(What|Of|Who|Where)\b")
SENTENCES_END = re.compile(r"""(?<=[.!?])["'`)]*\s+|\n\s*\n|^\s*(?:- |:\w[^:\n]*: )""", re.MULTILINE)


def names(*patterns: str) -> list[str]:
    """Files of the repository, by path."""
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files", *patterns], capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("Not a git checkout.")
    return listed.stdout.split()


def files() -> list[Path]:
    """Code, settings and pages; results keep the names of the commits that made them."""
    listed = names("*.py", "*.yml", "*.md", "*.toml", "Makefile")
    return [ROOT / name for name in listed if not name.startswith("results/") and name != "tests/test_words.py"]


def texts(source: str) -> Iterator[str]:
    """Docstrings and comments of a file; comments on neighbouring lines are one text."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""
    comments: list[str] = []
    below = None
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            (row, column), text = token.start, token.string.lstrip("# ")
            if token.start == below:
                comments[-1] += f"\n{text}"
            else:
                comments.append(text)
            below = (row + 1, column) if token.line.lstrip().startswith("#") else None
    yield from comments


def paragraphs(page: str) -> list[str]:
    """Text of a page without code; an entry of a list and a cell of a table are texts of their own."""
    plain = re.sub(r"(```|~~~).*?\1|`[^`\n]*`|[*_>\[]", "", page, flags=re.DOTALL)
    return re.split(r"\n\s*\n|^\s*(?:- |\d+\. |#+ )|\|", plain, flags=re.MULTILINE)


def misbegun(found: Iterable[str]) -> list[str]:
    """Sentences that begin like a question and are none."""
    sentences = (sentence.strip() for text in found for sentence in SENTENCES_END.split(text))
    return [sentence for sentence in sentences if ASKS.match(sentence) and not sentence.endswith("?")]


def test_words_of_earlier_versions_are_gone():
    found = []
    for path in files():
        for number, line in enumerate(path.read_text().splitlines(), start=1):
            found += [f"{path.relative_to(ROOT)}:{number}: {word}" for word in WORD.findall(line)]
    assert found == []
    assert [name for name in names() if WORD.search(re.sub(r"[_/.-]", " ", name))] == []


def test_a_word_is_found():
    assert WORD.findall("Peers steer n_candidates, not return_weighting or a pioneer.") == ["Peers", "steer", "n_candidates"]
    assert WORD.findall("def _carry_out(self, carry_outs, __carry_out):") == ["carry_out"]


def test_sentences_begin_with_their_subject():
    readers = {".py": texts, ".md": paragraphs}
    paths = [path for path in files() if path.suffix in readers and path.relative_to(ROOT).parts[0] in (*FOLDERS, path.name)]
    assert {path.suffix for path in paths} == readers.keys()
    found = {path: misbegun(readers[path.suffix](path.read_text())) for path in paths}
    assert {path.relative_to(ROOT): each for path, each in found.items() if each} == {}


def test_a_sentence_is_found():
    source = '''
def f(x):
    """
    Return x. Where is it? What
    it was is gone.

    :param x: Of numbers
    """
    # Whatever comes. The sum
    # Of both.
    y = "# What"  # Who knows
    return y
'''
    assert misbegun(texts(source)) == ["What\nit was is gone.", "Of numbers", "Who knows"]
    page = """# What is it?
**Where it is.** Here. Of these:
- What fits
| a | Who |
"""
    assert misbegun(paragraphs(page)) == ["Where it is.", "Of these:", "What fits", "Who"]
