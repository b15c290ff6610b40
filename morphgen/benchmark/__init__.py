"""The life of a split: rules, audit, build, goals, licences, release and scores."""
