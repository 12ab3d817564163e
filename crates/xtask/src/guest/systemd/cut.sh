systemctl start multi-user.target
await is_active
begin
touch "/share/$STAGE/midway"
wait $client
check "a run that is not cut off completes" is_complete
failures=$failed
