"""The paper's figures and tables for a robot, as written by `mmrjax reproduce`."""
