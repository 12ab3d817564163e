# The far end of a mirror controller's serial line ($1), in shell: agrees to every line, and notes them in $2.
exec 3<>"$1"
while IFS= read -r line <&3; do
    printf '%s\n' "$line" >>"$2"
    printf 'OK\r\n' >&3
done
