"""The Train step: learns the scene."""
