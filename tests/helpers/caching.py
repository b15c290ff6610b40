"""Functions that a test module calls once for the same arguments, as they take long."""


def once(function, key):
    """Return a function that calls another one once for each key of its arguments."""
    known = {}

    def cached(*args, **options):
        at = key(*args, **options)
        if at not in known:
            known[at] = function(*args, **options)
        return known[at]

    return cached
