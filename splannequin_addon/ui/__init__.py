"""Shared code of the steps' panels and operators, the menu, and the preferences."""
