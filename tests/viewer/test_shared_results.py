"""Results that the pages of all browsers share."""

from morphgen.viewer.app.workers import SharedResults


def test_a_result_is_made_once_and_the_least_recently_used_is_dropped():
    shared, made = SharedResults(max_results=2), []

    def get(key):
        return shared.get(key, lambda: made.append(key) or key.upper())

    assert [get(key) for key in "aabacab"] == list("AABACAB")
    assert made == ["a", "b", "c", "b"]
    assert (get("a"), get("c")) == ("A", "C")
    assert made[4:] == ["c"]
