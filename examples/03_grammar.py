"""Write a grammar of your own and draw 1,000 robots from it.

    python examples/03_grammar.py [N]

Prints how often each end-effector was drawn, the ranges of mass and degrees of freedom, and the
first robot's derivation, from which the same robot can be made again.
"""

import sys
from collections import Counter
from pathlib import Path

import morphgen

# %%
# A production says what a symbol becomes. Alternatives may have weights, values may be random, and
# robots that break the condition are drawn again.
grammar = Path("workbench.grammar")
grammar.write_text("""\
robot -> base arm ee
base  -> fixed | pedestal(height=uniform(0.2, 0.5))
arm   -> arm3(length=uniform(0.2, 0.5), radius=uniform(50mm, 80mm)) | bead{2,5}
ee    -> @weight(2) plane(size=uniform(0.05, 0.15)) | stick(length=uniform(0.1, 0.3))
where dof >= 3 and mass < 60
""")

# %%
# The same seed gives the same robots, and robot i does not depend on their number.
count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
robots = list(morphgen.sample(grammar, count, seed=7))
tools = Counter(robot.links[-1].name for robot in robots)
masses = [robot.mass for robot in robots]
dofs = [robot.dof for robot in robots]
print(f"{len(robots)} robots, last links: {dict(sorted(tools.items()))}")
print(f"mass {min(masses):.1f} to {max(masses):.1f} kg, {min(dofs)} to {max(dofs)} DoF")

# %%
# A robot carries its derivation. `morphgen sample` writes such a set to a folder, with an index.
print(robots[0].provenance["derivation"])
