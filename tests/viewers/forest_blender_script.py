"""Import a USD stage in Blender, and print the matrices of all instances of meshes as JSON: forest_blender_script.py STAGE."""

import json
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=sys.argv[1])
found = [
    [list(row) for row in each.matrix_world]
    for each in bpy.context.evaluated_depsgraph_get().object_instances
    if each.is_instance and each.object.type == "MESH"
]
print("\n" + json.dumps(found))
