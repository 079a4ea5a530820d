"""Where probes come from: folders of CSV lines, LinuxCNC, and controls that print lines (DPRNT)."""
