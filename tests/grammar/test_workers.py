"""Sampling on a Ray cluster of two local nodes with one process each."""

from pathlib import Path

import pytest

from helpers.commands import tree
from helpers.grammars import shipped
from morphgen.errors import MorphgenError
from morphgen.grammar.grammar_file import grammar_text
from morphgen.grammar.robot_set import SetConfig, make_in_processes, make_on_ray, make_set
from morphgen.grammar.sampling import SamplingError

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def address():
    """Address of a cluster of two nodes."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    yield cluster.address
    cluster.shutdown()


def plan(folder: Path, where=()) -> SetConfig:
    text = grammar_text(shipped("cubes"))
    return SetConfig(folder, "cubes", text, 0, where, light=True, picture=False, library=())


def test_a_ray_cluster_writes_the_same_bytes_as_one_process(address, tmp_path):
    make_set(plan(tmp_path / "serial"), 40, make_in_processes())
    report = make_set(plan(tmp_path / "ray"), 40, make_on_ray(address))
    assert report.made == 40
    assert tree(tmp_path / "ray") == tree(tmp_path / "serial")


def test_an_unsatisfiable_condition_is_an_error(address, tmp_path):
    with pytest.raises(SamplingError, match="0 of 500 draws") as refused:
        make_set(plan(tmp_path / "set", ("mass > 1000",)), 4, make_on_ray(address))
    assert "Traceback" not in str(refused.value)


def test_an_address_without_a_cluster_is_an_error(tmp_path):
    with pytest.raises(MorphgenError, match=r"no Ray cluster at '127\.0\.0\.1:1': .*refused"):
        make_set(plan(tmp_path / "set"), 4, make_on_ray("127.0.0.1:1"))
