"""Properties declared in a class become Blender properties when the class is registered."""

import inspect

import bpy


def test_what_a_class_and_its_base_assign_becomes_what_blender_reads(addon):
    properties = addon("properties")

    class Base:
        count = properties.IntProperty(name="Count", default=3)

    class Group(Base, bpy.types.PropertyGroup):
        word = properties.StringProperty(name="Word", default="a")

    for _ in range(2):  # twice, like disabling and enabling the add-on
        properties.annotate(Group)
        bpy.utils.register_class(Group)
        properties.release(Group)
        try:
            rna_properties = Group.bl_rna.properties
            assert (rna_properties["count"].default, rna_properties["word"].default) == (3, "a")
            assert "count" not in vars(Base) and "word" not in vars(Group)
        finally:
            bpy.utils.unregister_class(Group)


def test_every_property_that_a_class_assigns_is_blenders_and_nothing_of_it_is_left(package, addon):
    """A property left in a class is no setting. One left in its annotations crashes Blender 4.2 when Python exits."""
    properties = addon("properties")
    kinds = (bpy.types.Operator, bpy.types.PropertyGroup, bpy.types.AddonPreferences)
    classes = [c for kind in kinds for c in kind.__subclasses__() if c.__module__.startswith(f"{package.__name__}.")]
    seen = 0
    for cls in classes:
        known = cls.bl_rna.properties
        if issubclass(cls, bpy.types.Operator):
            known = getattr(bpy.ops.splannequin, cls.bl_idname.partition(".")[2]).get_rna_type().properties
        for one in cls.__mro__:
            assert not [n for n, v in vars(one).items() if isinstance(v, properties._Declared)], cls
            annotations = inspect.get_annotations(one) if one in properties._declared else {}
            assert all(isinstance(kind, str) for kind in annotations.values()), cls
            assert all(name in known for name in annotations), cls
            seen += len(annotations)
    assert seen > 60
