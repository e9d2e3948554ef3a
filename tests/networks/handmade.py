"""A net written by hand, with round numbers, for tests that need to know every lane: no SUMO has seen it.

Leg A comes from the north: two main lanes of 200 m (rising 1 %), a split of 1 m, and a part of 100 m with a third lane
as left pocket (level for 50 m, then falling 4 %). From its lanes 0 and 1 one goes straight to C, from lane 2 left to B,
over two inside lanes of 8 and 12 m. Leg B comes from the east: one lane of 150 m, right to A (9 m), left to C (14 m).
Leg C only leads away. A's left turn is green twice a cycle: permissive in the first phase, protected in the third.
"""

from pathlib import Path

HANDMADE_NET = """<net version="1.20">
  <edge id=":S_0" function="internal">
    <lane id=":S_0_0" index="0" speed="15" length="1" shape="0,111,2 0,110,2"/>
    <lane id=":S_0_1" index="1" speed="15" length="1" shape="3,111,2 3,110,2"/>
    <lane id=":S_0_2" index="2" speed="15" length="1" shape="3,111,2 6,110,2"/>
  </edge>
  <edge id=":TL_0" function="internal">
    <lane id=":TL_0_0" index="0" speed="15" length="20" shape="0,10 0,-10"/>
    <lane id=":TL_0_1" index="1" speed="15" length="20" shape="3,10 3,-10"/>
  </edge>
  <edge id=":TL_2" function="internal"><lane id=":TL_2_0" index="0" speed="8" length="8" shape="6,10 6,2"/></edge>
  <edge id=":TL_9" function="internal"><lane id=":TL_9_0" index="0" speed="8" length="12" shape="6,2 18,2"/></edge>
  <edge id=":TL_4" function="internal"><lane id=":TL_4_0" index="0" speed="8" length="9" shape="20,5 11,5"/></edge>
  <edge id=":TL_5" function="internal"><lane id=":TL_5_0" index="0" speed="8" length="14" shape="20,5 6,5"/></edge>
  <edge id="AB2A" from="X" to="A">
    <lane id="AB2A_0" index="0" speed="15" length="246" shape="0,560 0,314"/>
    <lane id="AB2A_1" index="1" speed="15" length="246" shape="3,560 3,314"/>
  </edge>
  <edge id="AA2A" from="Y" to="A"><lane id="AA2A_0" index="0" speed="15" length="90" shape="90,314 0,314"/></edge>
  <edge id="A2TL" from="A" to="S">
    <lane id="A2TL_0" index="0" speed="15" length="200" shape="0,311,0 0,111,2"/>
    <lane id="A2TL_1" index="1" speed="15" length="200" shape="3,311,0 3,111,2"/>
  </edge>
  <edge id="A2TL_intern" from="S" to="TL">
    <lane id="A2TL_intern_0" index="0" speed="15" length="100" shape="0,110,2 0,60,2 0,10,0"/>
    <lane id="A2TL_intern_1" index="1" speed="15" length="100" shape="3,110,2 3,60,2 3,10,0"/>
    <lane id="A2TL_intern_2" index="2" speed="15" length="100" shape="6,110,2 6,60,2 6,10,0"/>
  </edge>
  <edge id="BB2B" from="Z" to="B"><lane id="BB2B_0" index="0" speed="12" length="80" shape="250,5 170,5"/></edge>
  <edge id="B2TL" from="B" to="TL"><lane id="B2TL_0" index="0" speed="12" length="150" shape="170,5 20,5"/></edge>
  <edge id="TL2A" from="TL" to="A"><lane id="TL2A_0" index="0" speed="15" length="120" shape="11,5 11,125"/></edge>
  <edge id="TL2B" from="TL" to="B"><lane id="TL2B_0" index="0" speed="12" length="90" shape="18,2 108,2"/></edge>
  <edge id="TL2C" from="TL" to="C">
    <lane id="TL2C_0" index="0" speed="15" length="180" shape="0,-10 0,-190"/>
    <lane id="TL2C_1" index="1" speed="15" length="180" shape="3,-10 3,-190"/>
  </edge>
  <tlLogic id="TL" type="static" programID="0" offset="7">
    <phase duration="30" state="GGgsr"/><phase duration="3" state="yyysr"/>
    <phase duration="6" state="rrGsr"/><phase duration="3" state="rrysr"/>
    <phase duration="20" state="rrrGG"/><phase duration="3" state="rrryy"/>
  </tlLogic>
  <junction id="A" type="priority" x="0" y="311"/><junction id="B" type="priority" x="170" y="5"/>
  <junction id="C" type="dead_end" x="0" y="-190"/><junction id="S" type="priority" x="0" y="110"/>
  <junction id="TL" type="traffic_light_right_on_red" x="5" y="0"/>
  <connection from="AB2A" to="A2TL" fromLane="0" toLane="0" dir="s"/>
  <connection from="AB2A" to="A2TL" fromLane="1" toLane="1" dir="s"/>
  <connection from="AA2A" to="A2TL" fromLane="0" toLane="0" dir="r"/>
  <connection from="BB2B" to="B2TL" fromLane="0" toLane="0" dir="s"/>
  <connection from="A2TL" to="A2TL_intern" fromLane="0" toLane="0" via=":S_0_0" dir="s"/>
  <connection from="A2TL" to="A2TL_intern" fromLane="1" toLane="1" via=":S_0_1" dir="s"/>
  <connection from="A2TL" to="A2TL_intern" fromLane="1" toLane="2" via=":S_0_2" dir="s"/>
  <connection from="A2TL_intern" to="TL2C" fromLane="0" toLane="0" via=":TL_0_0" tl="TL" linkIndex="0" dir="s"/>
  <connection from="A2TL_intern" to="TL2C" fromLane="1" toLane="1" via=":TL_0_1" tl="TL" linkIndex="1" dir="s"/>
  <connection from="A2TL_intern" to="TL2B" fromLane="2" toLane="0" via=":TL_2_0" tl="TL" linkIndex="2" dir="l"/>
  <connection from="B2TL" to="TL2A" fromLane="0" toLane="0" via=":TL_4_0" tl="TL" linkIndex="3" dir="r"/>
  <connection from="B2TL" to="TL2C" fromLane="0" toLane="0" via=":TL_5_0" tl="TL" linkIndex="4" dir="l"/>
  <connection from=":S_0" to="A2TL_intern" fromLane="0" toLane="0" dir="s"/>
  <connection from=":S_0" to="A2TL_intern" fromLane="1" toLane="1" dir="s"/>
  <connection from=":S_0" to="A2TL_intern" fromLane="2" toLane="2" dir="s"/>
  <connection from=":TL_0" to="TL2C" fromLane="0" toLane="0" dir="s"/>
  <connection from=":TL_0" to="TL2C" fromLane="1" toLane="1" dir="s"/>
  <connection from=":TL_2" to="TL2B" fromLane="0" toLane="0" via=":TL_9_0" dir="l"/>
  <connection from=":TL_9" to="TL2B" fromLane="0" toLane="0" dir="l"/>
  <connection from=":TL_4" to="TL2A" fromLane="0" toLane="0" dir="r"/>
  <connection from=":TL_5" to="TL2C" fromLane="0" toLane="0" dir="l"/>
</net>"""


def write_handmade(folder: Path) -> Path:
    """Write the net into ``folder`` and return its path."""
    path = folder / "net.net.xml"
    path.write_text(HANDMADE_NET, encoding="utf-8")
    return path
