"""The card of the robot under the pointer: drawn by the browser from a table of capsules.

viser tells the server of clicks and rectangles, but not of a pointer that moves. So the browser
gets the cards once, and after every move of the camera or the robots the capsules of
``population_pick``, in which its own copy of ``robot_at`` searches.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence

import numpy as np

from morphgen.viewer.population_pick import TOLERANCE, Capsules

SCALE = 8192
"""Steps of the table's integers per height of the picture."""
_INSTALL = """
const hover = window.morphgenHover = { cards: %(cards)s, table: null };
document.getElementById("morphgen-hover")?.remove();
const card = document.createElement("div");
card.id = "morphgen-hover";
card.style.cssText = "position:fixed;display:none;pointer-events:none;z-index:50;padding:6px 9px;"
  + "border-radius:6px;font:12.5px/1.45 system-ui,sans-serif;max-width:300px;color:#212529;"
  + "background:#fffffff2;box-shadow:0 1px 8px #0004";
document.body.append(card);
const hide = () => { card.style.display = "none"; };
const find = (x, y) => {
  const t = hover.table;
  let best = %(tolerance)s, found = -1;
  for (let i = 0; t && i < t.length; i += 6) {
    const ax = t[i] - x, ay = t[i + 1] - y, dx = t[i + 2] - t[i], dy = t[i + 3] - t[i + 1];
    const share = Math.min(1, Math.max(0, -(ax * dx + ay * dy) / Math.max(dx * dx + dy * dy, 1)));
    const distance = Math.hypot(ax + share * dx, ay + share * dy) - t[i + 4];
    if (distance <= 0) return t[i + 5];
    if (distance <= best) { best = distance; found = t[i + 5]; }
  }
  return found;
};
window.addEventListener("pointermove", (event) => {
  if (window.morphgenHover !== hover) return;
  if (event.buttons || event.target.tagName !== "CANVAS") return hide();
  const box = event.target.getBoundingClientRect(), unit = %(scale)s / box.height;
  const robot = find((event.clientX - box.left) * unit, (event.clientY - box.top) * unit);
  event.target.style.cursor = robot < 0 ? "" : "pointer";
  if (robot < 0) return hide();
  card.innerHTML = hover.cards[robot];
  card.style.display = "block";
  card.style.left = Math.min(event.clientX + 14, box.right - card.offsetWidth - 4) + "px";
  card.style.top = Math.min(event.clientY + 14, box.bottom - card.offsetHeight - 4) + "px";
});
window.addEventListener("wheel", hide, { passive: true });
"""
_UPDATE = """
const bytes = Uint8Array.from(atob("%s"), (c) => c.charCodeAt(0));
if (window.morphgenHover) window.morphgenHover.table = new Int16Array(bytes.buffer);
"""


def install_script(cards: Sequence[str]) -> str:
    """Return the JavaScript that shows cards.

    Args:
        cards: HTML of each robot's card; text from outside is escaped.
    """
    values = {"cards": json.dumps(list(cards)), "tolerance": TOLERANCE * SCALE, "scale": SCALE}
    return _INSTALL % values


def update_script(capsules: Capsules) -> str:
    """Return the JavaScript that replaces the table of what is where in the picture."""
    return _UPDATE % base64.b64encode(pack_capsules(capsules)).decode()


def pack_capsules(capsules: Capsules) -> bytes:
    """Return six little-endian 16-bit integers per capsule: ends, radius, robot."""
    limit = 2**15 - 1
    table = np.empty((len(capsules.robot), 6))
    table[:, :4] = SCALE * capsules.ends.reshape(-1, 4)
    table[:, 4], table[:, 5] = SCALE * capsules.radius, capsules.robot
    return np.clip(np.round(table), -limit, limit).astype("<i2").tobytes()
