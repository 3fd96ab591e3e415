"""The LSS slave of the emulated node (CiA 305)."""
