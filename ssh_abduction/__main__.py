import sys

from ssh_abduction.cli import main

sys.exit(main())
