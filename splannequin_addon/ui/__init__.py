"""What the steps' panels and operators share, the menu, the preferences."""
