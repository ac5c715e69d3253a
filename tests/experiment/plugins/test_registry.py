"""Guards experiment/plugins/registry: plugins: found, refused with a reason, and built from checked options."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError, field_validator

import sparserob_core as sr
from sparserob_core.experiment.config.load import KEPT
from sparserob_core.experiment.plugins import registry as discovery
from sparserob_core.experiment.plugins.components import Registry
from sparserob_core.experiment.plugins.messages import complaints
from sparserob_core.options import meanings
from sparserob_core.testing import ContractBroken, MaximiserContract

GOOD = """
import sparserob_core as sr

class Weighted(sr.Regulariser, sr.Options):
    weight: float = 1.0
    '''How much.'''
    def quadratic(self, image):
        raise NotImplementedError

@sr.hookimpl
def sparserob_regularisers():
    yield sr.RegulariserPlugin(name="mine", factory=Weighted, summary="Mine.")
"""


@pytest.fixture
def plugin(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str, name: str = "mine") -> Path:
        file = tmp_path / f"{name}.py"
        file.write_text(text)
        return file

    return write


def load(*files: Path) -> Registry:
    return sr.load_registry(files, entry_points=False)


def test_the_framework_registers_its_own_components_like_anybody_else() -> None:
    registry = load()
    assert registry.names("method") == ["exchange", "nominal", "reweighted", "scenario", "sparserob", "sparsest"]
    assert registry.get("problem", "linear").plugin == "core"
    assert registry.names("solver") == ["auto", "dual_newton"]


def test_every_installed_plugin_loads() -> None:
    registry = sr.load_registry()
    assert registry.failures == ()
    assert {"piqp", "proxqp", "clarabel"} <= set(registry.names("solver"))


def test_every_installed_component_has_a_summary_and_documented_options() -> None:
    for record in sr.load_registry().records():
        assert record.summary, record
        if record.missing and record.open:
            continue
        for name, meaning in meanings(record.options_type()).items():
            assert meaning, f"{record}: option {name} has no description"


def test_one_file_is_a_plugin(plugin: Callable[[str], Path]) -> None:
    registry = load(plugin(GOOD))
    assert registry.get("regulariser", "mine").plugin == "mine"
    assert registry.build("regulariser", "mine", {"weight": 2}).weight == 2.0


def test_a_misspelt_option_names_the_nearest_one(plugin: Callable[[str], Path]) -> None:
    with pytest.raises(
        sr.InputError, match=r"regulariser mine: weigth: unknown key; did you mean 'weight'\? \(known: weight\)"
    ):
        load(plugin(GOOD)).build("regulariser", "mine", {"weigth": 2})


def test_an_option_of_the_wrong_type_is_named_with_what_was_given(plugin: Callable[[str], Path]) -> None:
    with pytest.raises(sr.InputError, match=r"regulariser mine: weight: must be a number \(got 'heavy'\)"):
        load(plugin(GOOD)).build("regulariser", "mine", {"weight": "heavy"})


def test_an_unknown_name_brings_the_nearest_known_names(plugin: Callable[[str], Path]) -> None:
    with pytest.raises(sr.PluginError, match=r"no regulariser is named 'mime'; did you mean 'mine'\?"):
        load(plugin(GOOD)).get("regulariser", "mime")


def test_a_name_registered_twice_names_both_plugins(plugin: Callable[[str, str], Path]) -> None:
    with pytest.raises(
        sr.PluginError, match=r"regulariser 'mine' is registered twice, by plugin 'first' .* and by plugin 'second'"
    ):
        load(plugin(GOOD, "first"), plugin(GOOD, "second"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("import not_there_at_all", "No module named 'not_there_at_all'"),
        ("def broken(:", "SyntaxError"),
        (
            GOOD.replace("def sparserob_regularisers", "def sparserob_regulariser"),
            "did you mean 'sparserob_regularisers'",
        ),
        (GOOD.replace("@sr.hookimpl\n", ""), "not marked with @sparserob_core.hookimpl"),
        (GOOD.replace("RegulariserPlugin", "SolverPlugin"), "expected records of type RegulariserPlugin"),
        (GOOD.replace('name="mine"', 'name="My Plugin"'), "name must match"),
        (GOOD.replace("factory=Weighted", "factory=3"), "factory must be a class or"),
        (GOOD.replace("factory=Weighted", "factory=Weighted, options=int"), "options must be a subclass"),
        ("x = 1", "it implements no hook"),
    ],
)
def test_a_plugin_that_is_asked_for_and_broken_says_why(plugin: Callable[[str], Path], text: str, reason: str) -> None:
    with pytest.raises(sr.PluginError, match="mine") as caught:
        load(plugin(text))
    assert reason in str(caught.value)


def test_a_component_of_another_kind_is_refused(plugin: Callable[[str], Path]) -> None:
    registry = load(plugin(GOOD.replace("class Weighted(sr.Regulariser, sr.Options)", "class Weighted(sr.Options)")))
    with pytest.raises(sr.PluginError, match=r"building it returned Weighted\(weight=1.0\), expected a Regulariser"):
        registry.build("regulariser", "mine")


def test_a_lazy_factory_is_imported_only_when_it_is_chosen(plugin: Callable[[str], Path]) -> None:
    registry = load(plugin(GOOD.replace("factory=Weighted", 'factory="nowhere.to_be:Found"')))
    assert registry.names("regulariser") == ["mine"]
    with pytest.raises(sr.PluginError, match=r"loading 'nowhere.to_be:Found' raised ModuleNotFoundError"):
        registry.build("regulariser", "mine")


class Entry:
    """An entry point of a distribution that does not exist."""

    dist = None
    value = "somewhere"

    def __init__(self, name: str, load: Callable[[], object]) -> None:
        self.name, self.load = name, load


@pytest.fixture
def entry_points(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def use(*entries: Entry) -> None:
        monkeypatch.setattr(discovery, "_find_entry_points", lambda failures: list(entries))
        discovery._load_installed.cache_clear()
        discovery._load_own.cache_clear()

    yield use
    monkeypatch.undo()
    discovery._load_installed.cache_clear()
    discovery._load_own.cache_clear()


SEARCH = """
import sparserob_core as sr

class Greedy(sr.Maximiser, sr.Options):
    {option} = 7.0
    def search(self, objective, rng):
        return float("inf")
    def helper(self):
        return 1.0

@sr.hookimpl
def sparserob_maximisers():
    yield sr.MaximiserPlugin(name="greedy", factory={factory}, summary="g")
"""


@pytest.mark.parametrize(
    "option",
    [
        *("budget", "polish", "name", "seed", "callback", "search", "polished", "copy", "model_config", "helper"),
        *("origin", "json", "model_fields", "model_dump"),
    ],
)
def test_an_option_that_bears_a_name_in_use_is_refused_when_its_plugin_is_loaded(
    option: str, plugin: Callable[[str], Path]
) -> None:
    with pytest.raises(sr.PluginError, match=rf"plugin 'mine'.*the option '{option}' bears a name that .* uses"):
        load(plugin(SEARCH.format(option=f"{option}: float", factory="Greedy")))


def test_an_alias_in_use_and_the_options_of_a_lazy_factory_are_refused_too(plugin: Callable[[str], Path]) -> None:
    aliased = SEARCH.format(option="often: float = __import__('pydantic').Field(alias='budget', default=1.0); x: float",
                            factory="Greedy")  # fmt: skip
    with pytest.raises(sr.PluginError, match="the option 'budget' bears a name"):
        load(plugin(aliased))
    lazy = SEARCH.format(option="budget: float", factory='"tests.experiment.plugins.test_registry:Lazy"')
    with pytest.raises(sr.PluginError, match="the option 'budget' bears a name"):
        load(plugin(lazy)).check("maximiser", "greedy", {})


@pytest.mark.parametrize("option", ["search", "polished", "scaled", "helper"])
def test_options_of_a_class_of_their_own_bear_no_name_of_the_component_s(
    option: str, plugin: Callable[[str], Path]
) -> None:
    apart = SEARCH.replace("Greedy(sr.Maximiser, sr.Options)", "Greedy(sr.Maximiser)").replace(
        "    {option} = 7.0\n", "    step = 1.0\n"
    )
    code = f"{apart}\nclass Own(sr.Options):\n    step: float = 1.0\n    {option}: float = 7.0\n"
    with pytest.raises(sr.PluginError, match=rf"the option '{option}' bears a name that its class uses"):
        load(plugin(code.format(factory="Greedy, options=Own")))
    load(plugin(code.replace(option + ": float", "other: float").format(factory="Greedy, options=Own")))


def test_a_lazy_factory_is_looked_at_when_it_builds(plugin: Callable[[str], Path]) -> None:
    file = plugin(
        "import sparserob_core as sr\n"
        "class Own(sr.Options):\n"
        "    search: float = 7.0\n"
        "@sr.hookimpl\n"
        "def sparserob_maximisers():\n"
        "    place = 'tests.experiment.plugins.test_registry:Searching'\n"
        "    yield sr.MaximiserPlugin(name='greedy', factory=place, options=Own, summary='g')\n"
    )
    with pytest.raises(sr.PluginError, match=r"the option 'search' bears a name that its class uses"):
        load(file).build("maximiser", "greedy", {})


class Searching(sr.Maximiser):
    def search(self, objective: sr.Objective, rng: object) -> float:
        return float("inf")


class Lazy(sr.Options):
    budget: float = 7.0


def test_every_key_and_argument_of_a_search_is_reserved() -> None:
    taken = {*inspect.signature(sr.maximise).parameters, *inspect.signature(sr.ask_tell).parameters, *KEPT}
    assert taken - {"options"} <= sr.MaximiserPlugin.reserved


def test_the_contract_refuses_an_option_that_bears_a_name_in_use() -> None:
    class Greedy(sr.Maximiser, sr.Options):
        """Nothing."""

        budget: float = 7.0

        def search(self, objective, rng):  # type: ignore[no-untyped-def]
            return float("inf")

    class Kept(MaximiserContract):
        component = Greedy

    with pytest.raises(ContractBroken, match="the framework uses itself: budget"):
        Kept().test_no_option_bears_a_name_that_the_framework_uses()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """A folder of the path beside the ordinary ones; it is given distributions as mappings of files to texts."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))

    def write(name: str, **files: str) -> Path:
        (folder / name).mkdir()
        for file, text in files.items():
            path = folder / (f"{file}.py" if file.startswith("module_") else f"{name}/{file.replace('_txt', '.txt')}")
            path.write_text(text)
        return folder

    def forget() -> None:
        discovery._load_installed.cache_clear()
        discovery._load_own.cache_clear()

    forget()
    yield write
    monkeypatch.undo()
    forget()


@pytest.mark.parametrize(
    ("name", "files"),
    [
        (".dist-info", {}),
        (".egg-info", {}),
        ("~parserob-1.0.dist-info", {"METADATA": "Metadata-Version: 2.1\nName: sparserob\nVersion: 1\n",
                                     "entry_points_txt": "[sparserob]\npiqp = nowhere\n"}),
        ("bad-1.0.dist-info", {"entry_points_txt": "[sparserob]\nno equals sign\n"}),
    ],
)  # fmt: skip
def test_a_folder_that_is_no_distribution_is_named_and_stops_nobody(
    name: str, files: dict[str, str], site: Callable[..., Path]
) -> None:
    folder = site(name, **files)
    for registry in (sr.load_registry(), discovery.load_own_registry()):
        assert "piqp" in registry.names("solver")
        assert [failure.plugin for failure in registry.failures] == [str(folder / name)]


def test_two_distributions_with_one_entry_point_are_both_named_and_the_advice_works(
    site: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    for who in ("first", "second"):
        site(
            f"{who}_pack-1.0.dist-info",
            METADATA=f"Metadata-Version: 2.1\nName: {who}-pack\nVersion: 1.0\n",
            entry_points_txt=f"[sparserob]\nmine = module_{who}\n",
            **{f"module_{who}": GOOD},
        )
    with pytest.raises(sr.PluginError, match=r"\(first-pack 1\.0, .*\(second-pack 1\.0, ") as caught:
        sr.load_registry()
    variable, word = str(caught.value).rpartition(" ")[2].split("=")
    monkeypatch.setenv(variable, word)
    assert sr.load_registry().get("regulariser", "mine").distribution in {"first-pack 1.0", "second-pack 1.0"}


def broken() -> object:
    raise ModuleNotFoundError("No module named 'gone'")


def test_an_installed_plugin_that_fails_stops_nobody_and_is_named(entry_points: Callable[..., None]) -> None:
    from types import ModuleType

    good = ModuleType("good")
    exec(GOOD, good.__dict__)
    entry_points(Entry("zeta", lambda: good), Entry("alpha", broken))
    registry = sr.load_registry()
    assert registry.names("regulariser") == ["mine"]
    assert [str(failure) for failure in registry.failures] == [
        "plugin 'alpha (?, somewhere)' failed to load: ModuleNotFoundError: No module named 'gone'"
    ]
    with pytest.raises(
        sr.PluginError, match=r"(?s)no solver is named 'piqp'.*note: plugin 'alpha .*No module named 'gone'"
    ):
        registry.get("solver", "piqp")


def test_a_disabled_plugin_is_not_even_imported(
    entry_points: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    entry_points(Entry("alpha", broken))
    monkeypatch.setenv("SPARSEROB_DISABLE_PLUGINS", "alpha, beta")
    registry = sr.load_registry()
    assert registry.failures == ()
    with pytest.raises(sr.PluginError, match="plugin 'alpha' is disabled by SPARSEROB_DISABLE_PLUGINS"):
        registry.get("solver", "piqp")


@pytest.mark.parametrize("name", ["exchange", "nominal", "reweighted", "scenario", "sparserob", "sparsest"])
def test_a_method_of_the_framework_is_its_own_options(name: str) -> None:
    registry = load()
    assert isinstance(registry.build("method", name), registry.get("method", name).options_type())


def test_a_constructor_names_the_option_at_fault() -> None:
    with pytest.raises(sr.InputError, match=r"Continuation\.factor: .* less than 1, got 2\.0"):
        sr.Continuation(factor=2.0)
    with pytest.raises(sr.InputError, match="Continuation: expected keywords only, got 1 without a name"):
        sr.Continuation(1.0)  # type: ignore[call-arg]


def test_where_directories_of_others_are_read_only_this_distribution_is_imported(
    entry_points: Callable[..., None], plugin: Callable[[str], Path]
) -> None:
    entry_points(Entry("alpha", broken), Entry("piqp", broken))
    registry = discovery.load_own_registry()
    assert registry.failures == ()
    assert registry.names("method") == ["exchange", "nominal", "reweighted", "scenario", "sparserob", "sparsest"]
    with pytest.raises(sr.PluginError, match=r"(?s)no regulariser is named 'mine'.*--plugins FILE"):
        registry.get("regulariser", "mine")
    assert discovery.load_own_registry([plugin(GOOD)]).names("regulariser") == ["mine"]


def test_a_component_of_a_file_can_be_sent_to_a_fresh_process(plugin: Callable[[str], Path]) -> None:
    import pickle
    import subprocess
    import sys

    sent = pickle.dumps(load(plugin(GOOD)).build("regulariser", "mine", {"weight": 2.0}))
    program = "import pickle, sys; print(pickle.load(sys.stdin.buffer))"
    there = subprocess.run([sys.executable, "-c", program], input=sent, capture_output=True, check=True)
    assert there.stdout.decode().strip() == "weight=2.0"


def test_a_file_is_read_anew_whenever_it_is_loaded(plugin: Callable[[str], Path]) -> None:
    assert load(plugin(GOOD)).build("regulariser", "mine").weight == 1.0
    assert load(plugin(GOOD.replace("1.0", "7.25"))).build("regulariser", "mine").weight == 7.25


def test_two_files_of_one_name_are_two_plugins(tmp_path: Path) -> None:
    for folder, name in (("a", "one"), ("b", "two")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "x.py").write_text(GOOD.replace('name="mine"', f'name="{name}"'))
    assert load(tmp_path / "a" / "x.py", tmp_path / "b" / "x.py").names("regulariser") == ["one", "two"]


def test_a_constructor_names_what_was_given_whatever_words_the_author_chose() -> None:
    class Mine(sr.Options):
        depth: int = 3
        width: int = 3

        @field_validator("depth")
        @classmethod
        def _even(cls, depth: int) -> int:
            if depth % 2:
                raise ValueError("an odd depth is forgotten")
            return depth

        @field_validator("width")
        @classmethod
        def _wide(cls, width: int) -> int:
            if width < 1:
                raise sr.InputError(expected="a width", got=f"{width}")
            return width

    with pytest.raises(sr.InputError) as refused:
        Mine(depth=5, width=-1)
    assert str(refused.value).splitlines() == [
        "Mine.depth: an odd depth is forgotten, got 5",
        "Mine.width: expected a width, got -1",
    ]


def test_the_members_of_a_union_name_a_value_once() -> None:
    class Either(BaseModel):
        size: int | list[int]

    with pytest.raises(ValidationError) as refused:
        Either.model_validate({"size": "wide"})
    [complaint] = complaints(refused.value, Either, {"size": "wide"})
    assert str(complaint) == "size: must be a whole number or must be a list (got 'wide')"
