"""Drawer, door and dial: move an object of one joint without a motor to one side."""
