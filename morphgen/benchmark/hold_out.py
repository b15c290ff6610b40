"""Generate splits from what they hold out: test robots have it, train robots do not.

The draws are stratified: each arm, then each end-effector, appears before one appears twice. Apart
from what is held out, a test robot has only parts of train robots.
"""

from __future__ import annotations

import hashlib
import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import partial
from itertools import product
from typing import TypeAlias

from morphgen.benchmark.regimes import (
    MAX_COMPOSED,
    NOTHING,
    SplitRequest,
    assemble,
    found,
    members,
    parts,
    pattern_robots,
)
from morphgen.encoding.similarity import is_near
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import PART_KINDS, Manifest
from morphgen.grammar.syntax import Derivation, parse_derivation
from morphgen.model.findings import Finding
from morphgen.processes import parallel_map
from morphgen.progress import part_of, stage
from morphgen.splits.split import (
    HOLD_OUT,
    HOLD_OUT_KEY,
    Candidate,
    DerivedRecipe,
    RobotFactory,
    Split,
    UnfitRobotError,
)

MANUFACTURER = "manufacturer"  # key of conditions on the manufacturer of a part
EXAMPLES = "arm=kinova*, manufacturer=Kinova or arm=ur5+ee=plane"
"""Examples of rules, for messages."""


@dataclass(frozen=True)
class _Condition:
    """A property of one part of a robot: ``arm=kinova*`` or ``manufacturer=Kinova``."""

    key: str  # kind of the part, or `MANUFACTURER`
    pattern: str  # name of the part, or of the manufacturer in any case, with shell wildcards

    def __str__(self) -> str:
        return f"{self.key}={self.pattern}"

    def matches(self, manifest: Manifest) -> bool:
        """Return whether it holds for a part."""
        if self.key == MANUFACTURER:
            name = manifest.manufacturer.lower()
            return bool(name) and fnmatchcase(name, self.pattern.lower())
        return self.key == manifest.kind and fnmatchcase(manifest.name, self.pattern)

    def matches_node(self, node: Derivation, library: Library) -> bool:
        """Return whether it holds for a part of a robot."""
        return self.matches(library.manifest(node.part))


@dataclass(frozen=True)
class HoldOutRule:
    """Conditions that hold together for a held-out robot, each for one of its parts."""

    conditions: tuple[_Condition, ...]

    def __str__(self) -> str:
        return "+".join(map(str, self.conditions))

    @property
    def holds_out_parts(self) -> bool:
        """Whether parts are held out as such, rather than a combination."""
        return len(self.conditions) == 1

    def holds(self, derivation: Derivation, library: Library) -> bool:
        """Test if a robot is held out."""
        return all(
            any(condition.matches_node(node, library) for node in derivation.walk())
            for condition in self.conditions
        )

    def matching_parts(self, derivation: Derivation, library: Library) -> frozenset[str]:
        """Return the parts of a robot for which a condition holds."""
        return frozenset(
            node.part
            for node in derivation.walk()
            if any(condition.matches_node(node, library) for condition in self.conditions)
        )


def parse_rules(
    texts: Sequence[str], library: Library, origin: str = "--hold-out"
) -> tuple[HoldOutRule, ...]:
    """Parse rules; each text has one, or several that are separated by commas."""
    rules: list[HoldOutRule] = []
    for text in texts:
        for entry in text.split(","):
            terms = [term.strip() for term in entry.split("+")]
            rule = HoldOutRule(tuple(_condition(term, text, library, origin) for term in terms))
            if rule in rules:
                raise BenchmarkError(f"{origin} {text}: {rule} is there twice")
            rules.append(rule)
    if not rules:
        raise BenchmarkError(f"{origin}: nothing is held out; expected such as {EXAMPLES}")
    return tuple(rules)


def held_out_parts(
    rules: Sequence[HoldOutRule], derivation: Derivation, library: Library
) -> frozenset[str]:
    """Return the parts of a robot that are held out as such; no train robot has them."""
    whole = [rule for rule in rules if rule.holds_out_parts]
    return frozenset[str]().union(*(rule.matching_parts(derivation, library) for rule in whole))


def _condition(term: str, text: str, library: Library, origin: str) -> _Condition:
    where = f"{origin} {text}" if term == text else f"{origin} {text}: {term or 'empty rule'}"
    key, _, value = term.partition("=")
    if not key or not value:
        raise BenchmarkError(f"{where}: expected KEY=VALUE, such as {EXAMPLES}")
    keys = (*PART_KINDS, MANUFACTURER)
    if "." in key:
        raise BenchmarkError(
            f"{where}: a range of a parameter is a rule of morphgen 0.3 alone; audit the split "
            "with 0.3, or hold sizes out by `split new interpolation --hull outside`"
        )
    if key not in keys:
        raise BenchmarkError(f"{where}: unknown key {key!r}{nearest(key, keys)}")
    condition, manifests = _Condition(key, value), library.manifests()
    if not any(map(condition.matches, manifests)):
        of_kind = (each for each in manifests if key in (MANUFACTURER, each.kind))
        valid = {each.manufacturer if key == MANUFACTURER else each.name for each in of_kind}
        hint = nearest(value.strip("*?"), valid - {""})
        raise BenchmarkError(f"{where}: no {key} matches {value!r}{hint}")
    return condition


_Key: TypeAlias = tuple[int, ...]
_Item: TypeAlias = tuple[str, object]

STRATA = ("arm", "ee", "body", "base")
"""Kinds of parts whose use is balanced, the most important first. Segments are repeated at will."""


@dataclass(frozen=True, eq=False)
class _Draft:
    """A robot that may be drawn; it is composed when it is."""

    recipe: DerivedRecipe
    rules: tuple[int, ...]
    """Numbers of the rules that hold for the robot; none if it may be trained on."""
    parts: frozenset[str]
    required: frozenset[str]  # parts that some train robot must have if this is a test robot
    strata: tuple[list[_Item], ...]
    """Groups of items whose numbers are balanced, the most important group first: rules, parts that
    they hold for (alone or in a combination), category, and parts by their kind."""
    order: str  # random text that decides between robots that are equally good


@dataclass(frozen=True)
class _DraftMaker:
    """Convert derivations to drafts."""

    rules: tuple[HoldOutRule, ...]
    library: Library
    seed: int

    def draft(self, recipe: DerivedRecipe) -> _Draft:
        """Return the draft of a robot."""
        library, derivation = self.library, recipe.derivation
        numbers = [n for n, rule in enumerate(self.rules) if rule.holds(derivation, library)]
        matching = (self.rules[n].matching_parts(derivation, library) for n in numbers)
        kinds: set[_Item] = {
            (library.manifest(node.part).kind, node.part) for node in derivation.walk()
        }
        own_parts = parts(derivation)
        return _Draft(
            recipe,
            tuple(numbers),
            own_parts,
            own_parts - held_out_parts(self.rules, derivation, library),
            (
                [("rule", number) for number in numbers],
                [("held out", part) for part in frozenset[str]().union(*matching)],
                [("category", recipe.category)],
                *([item for item in kinds if item[0] == kind] for kind in STRATA),
            ),
            hashlib.sha256(f"{self.seed} {derivation}".encode()).hexdigest(),
        )


def _make_pool(maker: _DraftMaker, patterns: Sequence[str]) -> list[_Draft]:
    """Return every robot that may be drawn, each derivation once."""
    drafts: dict[str, _Draft] = {}
    for pattern in patterns:
        for recipe in pattern_robots(pattern, maker.library):
            if (text := str(recipe.derivation)) not in drafts:
                drafts[text] = maker.draft(recipe)
    return list(drafts.values())


def _stratified(
    drafts: Mapping[int, _Draft], n: int, needed: frozenset[str] = frozenset()
) -> list[int]:
    """Return up to n drafts, each the best after those before: of the rarest strata.

    Of several, it is the one with most of the needed parts that those lack.
    """
    counts: Counter[_Item] = Counter()
    missing = set(needed)

    def key(draft: _Draft) -> _Key:
        common = (max((counts[item] for item in group), default=0) for group in draft.strata)
        return (*common, -len(missing & draft.parts))

    # Keys never become better while robots are chosen, so only the first of the heap is updated.
    heap = [(key(draft), draft.order, number) for number, draft in drafts.items()]
    heapq.heapify(heap)
    chosen: list[int] = []
    while heap and len(chosen) < n:
        before, order, number = heapq.heappop(heap)
        draft = drafts[number]
        if (current := key(draft)) > before:
            heapq.heappush(heap, (current, order, number))
            continue
        chosen.append(number)
        counts.update(item for group in draft.strata for item in group)
        missing -= draft.parts
    return chosen


MAX_REJECTED = 500  # number of rejected robots after which the search fails


def _composed(factory: RobotFactory, draft: _Draft) -> Candidate | str:
    """Return the composed robot, or why it cannot be a member; runs in worker processes."""
    try:
        return factory(draft.recipe)
    except UnfitRobotError as error:
        return error.reason


@dataclass
class _HoldOutSearch:
    """Choose robots, compose them, reject those that do not do, and choose again."""

    request: SplitRequest
    maker: _DraftMaker
    factory: RobotFactory
    pool: dict[int, _Draft]
    robots: dict[int, Candidate] = field(default_factory=dict)
    """Composed robots by their number in the pool."""
    rejected: dict[int, str] = field(default_factory=dict)  # reason by number of the robot
    _compared: dict[tuple[int, int], bool] = field(default_factory=dict)

    def run(self, jobs: int) -> tuple[list[Candidate], list[Candidate]]:
        """Return the test and the train robots."""
        while True:
            test, train = self._choose()
            unknown = [number for number in (*test, *train) if number not in self.robots]
            self._require_enough(test, train, unknown)
            self._compose(unknown, len(test) + len(train), jobs)
            num_rejected = len(self.rejected)
            self._reject_repeated([*test, *train])
            self._reject_near(test, train)
            if not unknown and len(self.rejected) == num_rejected:
                self._require_all_rules(test)
                self._require_covered(test, train)
                return [self.robots[i] for i in test], [self.robots[i] for i in train]

    def _compose(self, unknown: Sequence[int], num_chosen: int, jobs: int) -> None:
        num_known = num_chosen - len(unknown)
        drafts = [self.pool[number] for number in unknown]
        with part_of(None, num_known):
            results = list(parallel_map(partial(_composed, self.factory), drafts, jobs))
        for number, result in zip(unknown, results, strict=True):
            if isinstance(result, str):
                self.rejected[number] = result
            else:
                self.robots[number] = result

    def _choose(self) -> tuple[list[int], list[int]]:
        """Return the numbers of the best test and train robots that are not rejected."""
        drafts = {n: draft for n, draft in self.pool.items() if n not in self.rejected}
        trainable = {n: draft for n, draft in drafts.items() if not draft.rules}
        train_parts = frozenset[str]().union(*(draft.parts for draft in trainable.values()))
        testable = {
            n: draft for n, draft in drafts.items() if draft.rules and draft.required <= train_parts
        }
        test = _stratified(testable, self.request.test)
        needed = frozenset[str]().union(*(drafts[n].required for n in test))
        train = _stratified(trainable, max(self.request.train), needed)
        return test, train

    def _require_enough(
        self, test: Sequence[int], train: Sequence[int], unknown: Sequence[int]
    ) -> None:
        """Raise if the robots are too few, once it is known how many differ."""
        if len(self.rejected) > MAX_REJECTED:
            raise BenchmarkError(
                f"{MAX_REJECTED} robots were rejected before enough were found{self._reasons()}"
            )
        # Composing shows which robots are the same; for many robots that takes too long.
        is_final = not unknown or len(unknown) > MAX_COMPOSED
        rules = " or ".join(map(str, self.maker.rules))
        for option, numbers, wanted, what in (
            ("--train", train, max(self.request.train), f"without {rules}"),
            ("--test", test, self.request.test, f"with {rules}"),
        ):
            if len(numbers) < wanted and (is_final or not numbers):
                count = f"{'at most' if unknown else 'only'} {len(numbers)}" if numbers else "no"
                what += ", whose other parts can be trained," if option == "--test" else ""
                raise BenchmarkError(
                    f"{option} {wanted}: {count} different robots {what} exist{self._reasons()}; "
                    "ask for fewer, or name more robots with --from"
                )

    def _require_all_rules(self, test: Sequence[int]) -> None:
        """Raise if a rule holds for no test robot."""
        for number, rule in enumerate(self.maker.rules):
            if not any(number in self.pool[n].rules for n in test):
                raise BenchmarkError(
                    f"--hold-out {rule}: no robots with it, whose other parts can be trained, "
                    f"exist{self._reasons()}; name more robots with --from"
                )

    def _require_covered(self, test: Sequence[int], train: Sequence[int]) -> None:
        """Raise if the smallest split does not train all other parts of its test robots."""
        smallest = self.request.train[0]
        required = frozenset[str]().union(*(self.pool[n].required for n in test))
        trained = [self.pool[n].parts for n in train]
        missing = required.difference(*trained[:smallest])
        if not missing:
            return
        sizes = range(smallest + 1, len(train) + 1)
        enough = next((size for size in sizes if not required.difference(*trained[:size])), None)
        raise BenchmarkError(
            f"--train {smallest}: no train robot has {', '.join(sorted(missing))}, which test "
            "robots have and --hold-out does not name; ask for "
            f"{f'{enough} or more' if enough else 'more'} train robots, or for fewer test robots"
        )

    def _reasons(self) -> str:
        counts = Counter(self.rejected.values()).most_common(2)
        reasons = ", ".join(f"{count} with {reason}" for reason, count in counts)
        links = f"more than {self.request.max_links} links"
        hint = "; see --max-links" if any(reason == links for reason, _ in counts) else ""
        return f" ({len(self.rejected)} rejected: {reasons}{hint})" if counts else ""

    def _reject_repeated(self, chosen: Sequence[int]) -> None:
        """Reject robots that are physically the same as an earlier one."""
        first: dict[str, int] = {}
        for number in chosen:
            if number in self.robots and number not in self.rejected:
                earlier = first.setdefault(self.robots[number].hash, number)
                if earlier != number:
                    self.rejected[number] = "the same hash as another robot"

    def _reject_near(self, test: Sequence[int], train: Sequence[int]) -> None:
        """Reject train robots that the audit would call nearly the same as a test robot."""
        for pair in product(test, train):
            if pair not in self._compared and all(n in self.robots for n in pair):
                test_robot, train_robot = (self.robots[n].features for n in pair)
                assert test_robot is not None
                assert train_robot is not None
                self._compared[pair] = is_near(test_robot, train_robot)
            if self._compared.get(pair) and not self.rejected.keys() & set(pair):
                self.rejected[pair[1]] = "almost the sizes of a test robot"


_UNNAMED = frozenset(("fixed", NOTHING))
"""Parts that a name leaves out: the usual base, and no end-effector."""
_MAX_LENGTH = 150
"""Longest name of parts [characters]; a suffix and a task still fit into a file's name."""


def parts_name(derivation: Derivation) -> str:
    """Return the parts of a robot, from the base outwards.

    Equal parts are counted, ``slides+5xbead+claw``, and those of a limb have its name,
    ``left-ur5+left-plane``. The base ``fixed`` is left out.
    """
    counts: Counter[str] = Counter()
    for node in derivation.walk():
        if node.part not in _UNNAMED:
            limb, _, kind = node.label.rpartition("_")
            counts[f"{limb}-{node.part}" if limb and kind in ("arm", "ee") else node.part] += 1
    words = [f"{n}x{part}" if n > 1 else part for part, n in counts.items()]
    return "+".join(words)[:_MAX_LENGTH] or derivation.part


def unique_names(derivations: Iterable[Derivation]) -> list[str]:
    """Return a name per robot; the second of a name ends in ``-2``, the third in ``-3``."""
    counts: Counter[str] = Counter()
    names: list[str] = []
    for derivation in derivations:
        name = parts_name(derivation)
        counts[name] += 1
        names.append(name if counts[name] == 1 else f"{name}-{counts[name]}")
    return names


def has_hold_out_rules(split: Split) -> bool:
    """Return whether a split claims to hold something out."""
    return split.regime == HOLD_OUT or HOLD_OUT_KEY in split.provenance


def hold_out_rules(split: Split, library: Library) -> tuple[HoldOutRule, ...]:
    """Return the rules of what a split holds out."""
    origin = f"split {split.name!r}: made: {HOLD_OUT_KEY}"
    texts = split.provenance.get(HOLD_OUT_KEY)
    if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
        raise BenchmarkError(f"{origin}: {texts!r}; expected a list such as ['arm=kinova*']")
    return parse_rules(texts, library, origin)


def hold_out_findings(split: Split, library: Library) -> Iterator[Finding]:
    """Yield the violations of what a split says is held out."""
    rules = hold_out_rules(split, library)
    train, test = (
        [(m, parse_derivation(m.derivation, f"derivation of {m.name!r}")) for m in members]
        for members in (split.train, split.test)
    )
    trained = frozenset[str]().union(*(parts(derivation) for _, derivation in train))
    for member, derivation in train:
        for rule in rules:
            if rule.holds(derivation, library):
                names = ", ".join(sorted(rule.matching_parts(derivation, library)))
                where = f"train robot {member.name}"
                yield found("held-out-trained", where, parts=names, rule=rule)
    for member, derivation in test:
        where = f"test robot {member.name}"
        if not any(rule.holds(derivation, library) for rule in rules):
            yield found("held-out-absent", where, rules=", ".join(map(str, rules)))
        unseen = parts(derivation) - trained - held_out_parts(rules, derivation, library)
        if unseen:
            yield found("part-unseen/rule", where, parts=", ".join(map(repr, sorted(unseen))))
    for rule in rules:
        if not any(rule.holds(derivation, library) for _, derivation in test):
            yield found("held-out-untested", f"rule {rule}")


DEFAULT_PATTERNS = ("arm=* ee=*",)  # robots that are drawn from if nothing is named


def hold_out(
    request: SplitRequest,
    hold_out: Sequence[str],
    library: Library,
    *,
    patterns: Sequence[str] = (),
    jobs: int = 1,
) -> tuple[Split, ...]:
    """Return splits whose test robots have held-out parts, and whose train robots have none."""
    rules = parse_rules(hold_out, library)
    if request.test < len(rules):
        raise BenchmarkError(
            f"--test {request.test}: {len(rules)} rules are held out, and each needs a test robot; "
            f"expected {len(rules)} or more"
        )
    patterns = patterns or DEFAULT_PATTERNS
    maker = _DraftMaker(rules, library, request.seed)
    factory = RobotFactory(library, with_features=True, max_links=request.max_links)
    with stage("drawing"):
        pool = dict(enumerate(_make_pool(maker, patterns)))
    search = _HoldOutSearch(request, maker, factory, pool)
    test, train = search.run(jobs)
    robots = [*train, *test]
    names = unique_names(robot.derivation for robot in robots)
    named = [replace(robot, name=name) for robot, name in zip(robots, names, strict=True)]
    provenance: dict[str, object] = {
        HOLD_OUT_KEY: [str(rule) for rule in rules],
        "from": list(patterns),
    }
    if search.rejected:
        provenance["left_out"] = dict(sorted(Counter(search.rejected.values()).items()))
    summary = f"{{n}} robots without {' or '.join(map(str, rules))}; test: {request.test} with it"
    first, second = (members(request, side) for side in (named[: len(train)], named[len(train) :]))
    return assemble(request, HOLD_OUT, summary, first, second, provenance)
