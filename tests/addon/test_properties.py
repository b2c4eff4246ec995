"""Properties that classes assign are Blender's once they are registered."""

import inspect

import bpy


def test_what_a_class_and_its_base_assign_becomes_what_blender_reads(addon):
    properties = addon("properties")

    class Base:
        count = properties.IntProperty(name="Count", default=3)

    class Group(Base, bpy.types.PropertyGroup):
        word = properties.StringProperty(name="Word", default="a")

    properties.annotate(Group)
    properties.annotate(Group)
    bpy.utils.register_class(Group)
    try:
        told = Group.bl_rna.properties
        assert (told["count"].default, told["word"].default) == (3, "a")
        assert "count" not in vars(Base) and "word" not in Group.__dict__
    finally:
        bpy.utils.unregister_class(Group)


def test_every_property_that_a_class_assigns_is_blenders(package):
    """Left in the class it would be an object that says nothing, and no setting."""
    kinds = (bpy.types.Operator, bpy.types.PropertyGroup, bpy.types.AddonPreferences)
    classes = [c for kind in kinds for c in kind.__subclasses__() if c.__module__.startswith(f"{package.__name__}.")]
    seen = 0
    for cls in classes:
        for one in cls.__mro__:
            assert not [n for n, v in vars(one).items() if isinstance(v, bpy.props._PropertyDeferred)], cls
            own = inspect.get_annotations(one)
            properties = [n for n, v in own.items() if isinstance(v, bpy.props._PropertyDeferred)]
            known = cls.bl_rna.properties
            if issubclass(cls, bpy.types.Operator):
                known = getattr(bpy.ops.splannequin, cls.bl_idname.partition(".")[2]).get_rna_type().properties
            assert all(n in known for n in properties), cls
            seen += len(properties)
    assert seen > 60
