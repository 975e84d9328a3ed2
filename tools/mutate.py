"""Mutation testing: change one place of a package, run the package's tests, count the changes that they notice.

`make mutate`, or `.venv/bin/python tools/mutate.py --mutants 300 --seed 0`; the changes are cosmic-ray's operators.
Each place of the code is drawn with equal chance, then one of the changes that can be made there. Every worker has a
copy of the tree, so yours is never touched. `--again` runs only what is not known to be noticed: after a stop, or
after new tests. Results and survivors: docs/mutation.md.

Left out is what mypy checks or nothing can notice: annotations, `if TYPE_CHECKING`, `@final`, and the arguments
`frozen` and `slots` of dataclasses.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from difflib import unified_diff
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory, TemporaryFile

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.provider import OperatorProvider
from scipy.stats import binomtest

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "build" / "mutation.jsonl"
TESTS = {
    "trace.py": ["tests/test_trace.py"],
    "stats": ["tests/stats"],
    "policy": ["tests/policy"],
    "plan": ["tests/plan"],
    "act": ["tests/act"],
    "store": ["tests/store", "tests/sweep/test_sweep.py"],
    "library.py": ["tests/test_library.py"],
    "transport": [
        "tests/transport",
        "tests/hostile/test_access.py",
        "tests/harness/test_serving.py",
        "tests/machine/test_doctor.py",
    ],
    "plugins/policy_servers": ["tests/plugins/policy_servers"],
    "plugins/paper/claims": ["tests/plugins/paper"],
    "report/compare/gates.py": ["tests/report/test_compare.py"],
    "plugins/two_hosts": ["tests/plugins/two_hosts"],
    "plugins/chunks": ["tests/plugins/chunks"],
}
"""Package -> the tests that belong to it."""
WITH_ARGUMENTS = ("VariableReplacer", "VariableInserter")
OPERATORS = {name: OperatorProvider()[name]() for name in OperatorProvider() if name not in WITH_ARGUMENTS}
SURVIVED = "survived"
MEMORY = 12 << 30
PYTEST = f"""
import resource, sys, pytest
resource.setrlimit(resource.RLIMIT_AS, ({MEMORY}, {MEMORY}))  # a mutant may fill the memory
sys.exit(pytest.main(sys.argv[1:]))
"""


@dataclass(frozen=True)
class Mutant:
    """One change at one place."""

    package: str
    path: str
    line: int
    column: int
    operator: str
    occurrence: int

    def source(self) -> str:
        """Return the changed file, unchanged where cosmic-ray cannot (`except a.b`)."""
        whole = (ROOT / self.path).read_text()
        try:
            return mutate_code(whole, OPERATORS[self.operator], self.occurrence) or whole
        except AttributeError:
            return whole

    def diff(self) -> str:
        """Return the lines that change."""
        lines = unified_diff((ROOT / self.path).read_text().splitlines(), self.source().splitlines(), n=0, lineterm="")
        return "\n".join(line for line in lines if not line.startswith(("---", "+++", "@@")))


def places(package: str) -> Iterator[list[Mutant]]:
    """Yield every place of a package, as the changes that can be made there."""
    target = ROOT / "s2a_bench" / package
    for path in [target] if target.is_file() else sorted(target.rglob("*.py")):
        found: dict[object, list[Mutant]] = defaultdict(list)
        nodes = list(ast_nodes(get_ast(path.read_text())))
        for name, operator in OPERATORS.items():
            positions = [position for node in nodes for position in operator.mutation_positions(node)]
            for occurrence, (start, end) in enumerate(positions):
                mutant = Mutant(package, str(path.relative_to(ROOT)), *start, name, occurrence)
                found[start, end].append(mutant)
        yield from found.values()


class _LeaveOut(ast.NodeTransformer):
    def visit_arg(self, node: ast.arg) -> ast.AST:
        node.annotation = None
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.annotation = ast.Constant(None)
        return self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        node.decorator_list = [decorator for decorator in node.decorator_list if ast.unparse(decorator) != "final"]
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> ast.AST | None:
        return None if "TYPE_CHECKING" in ast.unparse(node.test) else self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> ast.AST | None:
        return None if node.arg in {"frozen", "slots"} else self.generic_visit(node)


@cache
def meaning(source: str) -> str | None:
    """Return the code less what is left out; None where it is no Python."""
    try:
        return ast.dump(_LeaveOut().visit(ast.parse(source)))
    except SyntaxError:
        return None


def sample(number: int, seed: int, packages: Sequence[str]) -> list[Mutant]:
    """Draw mutants of packages; every place has the same chance."""
    chance = random.Random(seed)  # noqa: S311 - not secret
    drawn: list[Mutant] = []
    everywhere = [place for package in packages for place in places(package)]
    for place in chance.sample(everywhere, len(everywhere)):
        mutant = chance.choice(place)
        if meaning(mutant.source()) not in {None, meaning((ROOT / mutant.path).read_text())}:
            drawn.append(mutant)
        if len(drawn) == number:
            break
    return drawn


def copy_tree(target: Path) -> Path:
    """Copy what git has or would add."""
    command = ["git", "ls-files", "-zco", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True)  # noqa: S603
    for name in filter(None, listed.stdout.split("\0")):
        if os.path.lexists(ROOT / name):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name, follow_symlinks=False)
    return target


def run_tests(tree: Path, package: str, mutated: Path | None, limit_s: float | None) -> tuple[int | None, str]:
    """Run a package's tests, those named after the file first; return pytest's exit code, None after the limit."""
    files: list[Path] = []
    for test in TESTS[package]:
        files += sorted((tree / test).rglob("test_*.py")) if (tree / test).is_dir() else [tree / test]
    files.sort(key=lambda file: mutated is not None and mutated.stem not in file.stem)
    arguments = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--hypothesis-seed=0", *map(str, files)]
    variables = {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
    if mutated:
        variables["PYTHONDONTWRITEBYTECODE"] = "1"  # it would be taken for that of the next mutant
    with TemporaryFile("w+", errors="replace") as output:
        child = subprocess.Popen(  # noqa: S603
            [sys.executable, "-c", PYTEST, *arguments],
            cwd=tree,
            env=os.environ | variables,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = child.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
        output.seek(0)
        return code, output.read()[-2000:]


def judge(mutant: Mutant, tree: Path, limit_s: float) -> str:
    """Return which test notices a mutant, "timeout", or "survived"."""
    file = tree / mutant.path
    times, whole = file.stat(), file.read_text()
    file.write_text(mutant.source())
    try:
        code, output = run_tests(tree, mutant.package, file, limit_s)
    finally:
        file.write_text(whole)
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    if code is None:
        return "timeout"
    failures = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return (failures[0][:200] if failures else f"exit code {code}") if code else SURVIVED


class Workers:
    """Copies of the tree, each for one run of tests at a time."""

    def __init__(self, folder: Path, number: int) -> None:
        self._trees: SimpleQueue[Path] = SimpleQueue()
        for name in map(str, range(number)):
            self._trees.put(copy_tree(folder / name))
        self._limits_s: dict[str, float] = {}

    def try_unchanged(self, package: str) -> None:
        """Run the tests of a package without a change, which gives the limit in time of its mutants."""
        with self._tree() as tree:
            start = time.monotonic()
            code, output = run_tests(tree, package, None, None)
        if code:
            sys.exit(f"the tests of {package} fail without a change:\n{output}")
        self._limits_s[package] = 30 + 4 * (time.monotonic() - start)
        print(f"the tests of {package} pass in {time.monotonic() - start:.0f} s", flush=True)

    def judge(self, mutant: Mutant) -> tuple[Mutant, str]:
        """Return the mutant and its verdict."""
        with self._tree() as tree:
            return mutant, judge(mutant, tree, self._limits_s[mutant.package])

    @contextmanager
    def _tree(self) -> Iterator[Path]:
        tree = self._trees.get()
        try:
            yield tree
        finally:
            self._trees.put(tree)


def noticed() -> dict[Mutant, str]:
    """Read which mutants were noticed, and by which test."""
    lines = map(json.loads, RESULTS.read_text().splitlines())
    return {Mutant(**line["mutant"]): line["verdict"] for line in lines if line["verdict"] != SURVIVED}


def report(verdicts: dict[Mutant, str]) -> None:
    """Print the survivors, and the share that was noticed, of all and of each package, with its 95 % interval."""
    survivors = [mutant for mutant, verdict in verdicts.items() if verdict == SURVIVED]
    for mutant in sorted(survivors, key=lambda mutant: (mutant.path, mutant.line)):
        print(f"\n{mutant.path}:{mutant.line} {mutant.operator}\n{mutant.diff()}")
    print()
    for package in ("", *TESTS):
        number = sum(package in ("", mutant.package) for mutant in verdicts)
        killed = number - sum(package in ("", mutant.package) for mutant in survivors)
        if number:
            low, high = binomtest(killed, number).proportion_ci(method="wilson")
            print(f"{package or 'all'}: {killed} of {number} killed, {killed / number:.1%} ({low:.1%} to {high:.1%})")


def main() -> None:
    """Draw mutants, judge them, and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--packages", nargs="+", choices=[*TESTS], default=[*TESTS], metavar="PACKAGE")
    parser.add_argument("--again", action="store_true", help="only those not known to be noticed")
    arguments = parser.parse_args()
    drawn = sample(arguments.mutants, arguments.seed, arguments.packages)
    known = noticed() if arguments.again and RESULTS.exists() else {}
    rest = [mutant for mutant in drawn if mutant not in known]
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.workers) as pool:
        workers = Workers(Path(folder), arguments.workers)
        list(pool.map(workers.try_unchanged, {mutant.package for mutant in rest}))
        with RESULTS.open("a" if arguments.again else "w") as kept:
            for number, done in enumerate(as_completed([pool.submit(workers.judge, mutant) for mutant in rest]), 1):
                mutant, verdict = done.result()
                known[mutant] = verdict
                kept.write(json.dumps({"mutant": asdict(mutant), "verdict": verdict, "diff": mutant.diff()}) + "\n")
                kept.flush()
                print(f"{number}/{len(rest)} {mutant.path}:{mutant.line} {verdict}", flush=True)
    report({mutant: known[mutant] for mutant in drawn})


if __name__ == "__main__":
    main()
