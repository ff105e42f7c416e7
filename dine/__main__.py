from dine.cli import main

main()
