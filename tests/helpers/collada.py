"""A COLLADA file with a red and a blue part."""

from __future__ import annotations

DAE = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit meter="{unit}"/><up_axis>{up}</up_axis></asset>
  <library_effects>
    <effect id="red-fx"><profile_COMMON><technique sid="c"><lambert>
      <diffuse><color>1 0 0 1</color></diffuse></lambert></technique></profile_COMMON></effect>
    <effect id="blue-fx"><profile_COMMON><technique sid="c"><lambert>
      <diffuse><color>0 0 1 1</color></diffuse></lambert></technique></profile_COMMON></effect>
  </library_effects>
  <library_materials>
    <material id="red"><instance_effect url="#red-fx"/></material>
    <material id="blue"><instance_effect url="#blue-fx"/></material>
  </library_materials>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="pa" count="12">0 0 0 1 0 0 0 2 0 0 0 3</float_array>
      <technique_common><accessor source="#pa" count="4" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="1" material="m1"><input semantic="VERTEX" source="#v" offset="0"/>
      <p>0 2 1</p></triangles>
    <triangles count="3" material="m2"><input semantic="VERTEX" source="#v" offset="0"/>
      <p>0 1 3 1 2 3 0 3 2</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s"><node><translate>{shift}</translate>
    <instance_geometry url="#g"><bind_material><technique_common>
      <instance_material symbol="m1" target="#red"/>
      <instance_material symbol="m2" target="#blue"/>
    </technique_common></bind_material></instance_geometry></node></visual_scene>
  </library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""
