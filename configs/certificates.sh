#!/bin/sh
# Certificates for a campaign on several hosts, with openssl:
#
#   configs/certificates.sh DIR HEAD [HOST …]
#   configs/certificates.sh DIR orchestrator=NODE,NODE,… agent
#
# makes an authority in DIR and for every name a directory DIR/NAME with authority.pem, certificate.pem and key.pem, for
# `calmwalk run --tls` on the first and `calmwalk agent --tls` on the others. Agents check that the name of the
# orchestrator's certificate is the one that they connect to; where it may run on several hosts its certificate has all
# their names, after '='. Run again with more names it adds to what is there.
# Keep DIR/authority-key.pem to yourself: anyone who has it can take part in the campaign.
set -euf
umask 077
directory=$1
shift
mkdir -p "$directory"
if [ ! -e "$directory/authority.pem" ]; then
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 -subj "/CN=calmwalk campaign" \
        -keyout "$directory/authority-key.pem" -out "$directory/authority.pem"
fi
for names in "$@"; do
    name=${names%%=*}
    own=$directory/$name
    mkdir -p "$own"
    subject=
    for host in $(echo "${names#*=}" | tr ',' ' '); do
        case $host in
            *[!0-9.]*) subject="$subject,DNS:$host" ;;
            *) subject="$subject,IP:$host" ;;
        esac
    done
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$name" \
        -keyout "$own/key.pem" -out "$own/request.pem"
    printf 'subjectAltName=%s\nextendedKeyUsage=serverAuth,clientAuth\n' "${subject#,}" > "$own/extensions"
    openssl x509 -req -in "$own/request.pem" -days 3650 -extfile "$own/extensions" -CA "$directory/authority.pem" \
        -CAkey "$directory/authority-key.pem" -CAcreateserial -out "$own/certificate.pem"
    rm "$own/request.pem" "$own/extensions"
    cp "$directory/authority.pem" "$own/authority.pem"
done
