from adaptgns.reproduce import main

main()
