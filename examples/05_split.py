"""Load a split of train and test robots, measure it and audit it for leaks.

Prints the sizes of both sides, how similar the test robots are to the train robots, the findings of
the audit, and the train robot that is nearest to each test robot.
"""

import morphgen

# %%
# A split names its robots by derivations and hashes; they are composed when you use them.
split = morphgen.split("interpolation/arm3/reach")
print(f"{split.name}: {len(split.train)} train robots, {len(split.test)} test robots")
print(split.test[0])

# %%
# Statistics of the robots, and the cosine similarity of test and train robots.
statistics = split.statistics()
print({side: statistics[side]["links"] for side in ("train", "test")}, statistics["cosine"])

# %%
# The audit composes all robots, compares each test robot with each train robot, and checks the
# rules of the split's regime.
audit = split.audit()
print(f"passed: {audit.passed()}, {len(audit.findings)} findings, {len(audit.accepted)} accepted")
for test, by_measure in audit.nearest.items():
    for measure, nearest in by_measure.items():
        print(f"{test}: nearest by {measure}: {nearest.train} ({nearest.value:.3f})")

# %%
# The same measures for robots of your own choice: 1 means equal, and 0 for the distance `tree`.
for measure, values in morphgen.similarity([split.test[0], *split.train[:2], "ur5-plane"]).items():
    print(measure, values[0].round(2))
